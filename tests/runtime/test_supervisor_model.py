"""The supervisor and its table against a slow specification: a history, and what must have happened in it.

The specification keeps every step and looks back through all of it each time; it knows neither the table nor the
supervisor's variables.
"""

import msgspec
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from disco_hw.runtime import TRANSITIONS, State
from disco_hw.runtime.supervisor import Inputs, Supervisor, SupervisorSettings, UserRequest
from drivers.types import DriverState, LinkState, Request

ZERO_S, DISARM_S, STATIONARY_RAD_S = 0.05, 0.15, 0.05
SETTINGS = SupervisorSettings(ZERO_S, DISARM_S, pose_required=True)
TALKS = {
    DriverState.STANDBY, DriverState.READY, DriverState.ARMING, DriverState.ARMED, DriverState.STOPPING,
}  # fmt: skip
MAY_MOVE = {DriverState.ARMING, DriverState.ARMED, DriverState.STOPPING}
ARMINGS = {UserRequest.ARM, UserRequest.ARM_UNRECORDED}
IDLE = {DriverState.STANDBY, DriverState.READY}
LATCHED = {DriverState.FAULT, DriverState.ESTOP, DriverState.REFUSED}
AGES = st.sampled_from([0.0, 0.01, 0.05, 0.0501, 0.1, 0.15, 0.1501, 1.0, float("nan"), None])
HEALTHY = Inputs(LinkState.UP, 1, DriverState.READY, "ready", 0.01, 0.0, pose_ok=True)
VALUES = {
    "link_state": st.sampled_from(LinkState),
    "link_generation": st.integers(1, 3),
    "driver_state": st.sampled_from(DriverState),
    "telemetry_age_s": AGES,
    "wheel_speed_rad_s": st.sampled_from([0.0, 0.049, 0.05, 3.0, float("nan")]),
    "pose_ok": st.booleans(),
    "heading_missing": st.booleans(),
    "measures_no_heading": st.booleans(),
    "by_hand": st.booleans(),
    "preflight_errors": st.sampled_from([(), ("limits differ",)]),
    "recording_fault": st.sampled_from(["", "no room"]),
}
ONE_CHANGE = st.sampled_from(sorted(VALUES)).flatmap(lambda name: st.fixed_dictionaries({name: VALUES[name]}))
REQUESTS = st.lists(st.sampled_from(UserRequest), max_size=2)


def fresh(inputs):
    return inputs.telemetry_age_s is not None and inputs.telemetry_age_s <= ZERO_S


def is_telemetry_lost(inputs):
    return inputs.telemetry_age_s is None or not inputs.telemetry_age_s <= DISARM_S


def troubled(inputs):
    return bool(inputs.preflight_errors) or inputs.driver_state in LATCHED


class SupervisorModel(RuleBasedStateMachine):
    @initialize()
    def start(self):
        self.supervisor = Supervisor(SETTINGS)
        self.inputs = HEALTHY
        self.now_ns = 0
        self.history = []

    @rule(change=ONE_CHANGE, requests=REQUESTS, wait_s=st.sampled_from([0.02, 0.02, 1.0, 4.0]))
    def change_inputs(self, change, requests, wait_s):
        self.inputs = msgspec.structs.replace(self.inputs, **change)
        self.step(requests, wait_s)

    @rule(changes=st.lists(ONE_CHANGE, min_size=2, max_size=4), requests=REQUESTS)
    def several_things(self, changes, requests):
        for change in changes:
            self.inputs = msgspec.structs.replace(self.inputs, **change)
        self.step(requests, 0.02)

    @rule(change=ONE_CHANGE, requests=REQUESTS)
    def change_inputs_while_driving(self, change, requests):
        self.a_good_arming(True)
        self.inputs = msgspec.structs.replace(self.inputs, **change)
        self.step(requests, 0.02)

    @rule(requests=st.lists(st.sampled_from(UserRequest), max_size=2))
    def all_is_well_again(self, requests):
        self.inputs = msgspec.structs.replace(HEALTHY, link_generation=self.inputs.link_generation)
        self.step(requests, 0.02)

    @rule(start=st.booleans())
    def a_good_arming(self, start):
        """What a well-behaved robot does when asked, so that the walk gets to ARMED often."""
        self.all_is_well_again([])
        self.all_is_well_again([])
        self.all_is_well_again([UserRequest.ARM, *([UserRequest.START] if start else [])])
        for state in (DriverState.ARMING, DriverState.ARMED, DriverState.ARMED):
            self.inputs = msgspec.structs.replace(self.inputs, driver_state=state)
            self.step([], 0.02)

    @rule(age_s=st.sampled_from([0.0501, 0.1, 0.15, 0.1501]))
    def samples_grow_old_while_driving(self, age_s):
        self.a_good_arming(True)
        self.inputs = msgspec.structs.replace(self.inputs, telemetry_age_s=age_s)
        self.step([], 0.02)

    @rule()
    def a_reset(self):
        self.all_is_well_again([UserRequest.RESET])

    def step(self, requests, wait_s):
        self.now_ns += round(wait_s * 1e9)
        inputs = msgspec.structs.replace(self.inputs, requests=tuple(requests))
        before = self.history[-1][1].state if self.history else State.DISCONNECTED
        output = self.supervisor.step(self.now_ns, inputs)
        self.history.append((inputs, output))
        assert output.detail
        assert len(output.replies) == len(requests)
        assert all(reply.text for reply in output.replies)
        if output.state is not before:
            assert any(before in row.sources and row.target is output.state for row in TRANSITIONS)
            assert output.events
        self.check_state(before, output.state, inputs)
        self.check_motion(inputs, output)
        self.check_requests(output)

    def renewed(self, inputs):
        """Whether the link has come up again since it was last seen up."""
        seen = [past.link_generation for past, _ in self.history[:-1] if past.link_state is LinkState.UP]
        return inputs.link_state is LinkState.UP and (not seen or seen[-1] != inputs.link_generation)

    def check_state(self, before, after, inputs):  # noqa: PLR0912 - one branch for each sentence
        """What the state must be, from the words of docs/safety.md."""
        robot = inputs.driver_state
        up = inputs.link_state is LinkState.UP
        if before is not State.DISCONNECTED and (not up or self.renewed(inputs)):
            assert after is State.DISCONNECTED
            return
        if before is State.DISCONNECTED:
            assert after is (State.HANDSHAKE if up else State.DISCONNECTED)
            return
        if before is not State.FAULT and (troubled(inputs) or self.is_estop_latched()):
            assert after is State.FAULT
            return
        match before:
            case State.FAULT:
                assert after in (State.FAULT, State.HANDSHAKE)
                if after is State.HANDSHAKE:
                    assert not troubled(inputs)
                    assert self.requested_since(UserRequest.RESET, State.FAULT)
            case State.ARMED:
                gone = (
                    is_telemetry_lost(inputs) or robot is not DriverState.ARMED or UserRequest.DISARM in inputs.requests
                )
                assert after is (State.STOPPING if gone else State.ARMED)
            case State.READY:
                assert after in (State.READY, State.ARMED, State.STOPPING, State.HANDSHAKE)
                if after is State.ARMED:
                    assert robot is DriverState.ARMED
                    assert fresh(inputs)
                    assert self.arming_requested()
                if robot not in TALKS or is_telemetry_lost(inputs):
                    assert after is not State.READY
                if robot in MAY_MOVE and not self.arming_requested():
                    assert after is State.STOPPING
            case State.STOPPING:
                assert after in (State.STOPPING, State.READY, State.HANDSHAKE)
                if after is State.READY:
                    assert robot in IDLE
                    assert fresh(inputs)
                    assert inputs.wheel_speed_rad_s < STATIONARY_RAD_S
            case State.HANDSHAKE:
                assert after in (State.HANDSHAKE, State.READY, State.STOPPING)
                assert (after is State.READY) == (robot in IDLE and fresh(inputs))
                assert (after is State.STOPPING) == (robot in MAY_MOVE)

    def requested_since(self, request, state):
        """Whether it was asked for in this step, or since the state was entered."""
        for inputs, output in reversed(self.history):
            if request in inputs.requests and any(r.request is request and r.accepted for r in output.replies):
                return True
            if output is not self.history[-1][1] and output.state is not state:
                return False
        return False

    def arming_requested(self):
        return any(self.requested_since(r, State.READY) for r in ARMINGS)

    def is_estop_latched(self):
        """Whether an e-stop was asked for and no reset accepted after it, in the order of the requests."""
        latched = False
        for _, output in self.history:
            for reply in output.replies:
                if reply.request is UserRequest.ESTOP:
                    latched = True
                elif reply.request is UserRequest.RESET and reply.accepted:
                    latched = False
        return latched

    def check_motion(self, inputs, output):
        if output.motion_allowed:
            assert output.state is State.ARMED
            assert inputs.driver_state is DriverState.ARMED
            assert fresh(inputs)
            assert inputs.by_hand or (inputs.pose_ok and not inputs.heading_missing)
            assert not troubled(inputs)
            assert not self.is_estop_latched()
            # Between the last time that it was not armed and now, somebody asked for it: arming, then starting.
            assert self.requested_before_motion()
            assert not output.zero_only
        if output.state not in (State.ARMED, State.STOPPING, State.FAULT):
            assert not output.zero_only
        if self.is_estop_latched() and inputs.link_state is LinkState.UP:
            assert output.send_estop == (inputs.driver_state is not DriverState.ESTOP)
        if is_telemetry_lost(inputs) and output.state is not State.ARMED:
            assert not output.zero_only
            assert not output.motion_allowed

    def requested_before_motion(self):
        started = False
        for inputs, output in reversed(self.history):
            accepted = {r.request for r in output.replies if r.accepted}
            started = started or UserRequest.START in accepted
            if UserRequest.STOP in inputs.requests and not started:
                return False
            if started and output.state is State.READY and ARMINGS & accepted:
                return True
            if ARMINGS & accepted and started:
                return True
            if output.state not in (State.ARMED, State.READY):
                return False
        return False

    def check_requests(self, output):
        """The robot is asked to arm only after a person asked for it, once for each asking; ARMED asks for nothing."""
        armings = sum(past.driver_request is Request.ARM for _, past in self.history)
        accepted = sum(r.request in ARMINGS and r.accepted for _, past in self.history for r in past.replies)
        assert armings <= accepted
        inputs, before = self.history[-1][0], self.history[-2][1].state if len(self.history) > 1 else None
        for reply in output.replies:
            if reply.request is UserRequest.ARM and inputs.recording_fault and before is not State.ARMED:
                assert not reply.accepted
        resets = sum(past.driver_request is Request.RESET for _, past in self.history)
        accepted = sum(r.request is UserRequest.RESET and r.accepted for _, past in self.history for r in past.replies)
        assert resets <= accepted
        if output.state is State.ARMED:
            assert output.driver_request is None


@pytest.mark.parametrize("walks", [25, pytest.param(80, marks=pytest.mark.thorough)])
def test_the_supervisor_agrees_with_its_specification(walks):
    run_state_machine_as_test(SupervisorModel, settings=settings(max_examples=walks, stateful_step_count=30))
