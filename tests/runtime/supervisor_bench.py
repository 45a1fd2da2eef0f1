"""A supervisor on the bench, with a stand-in for the robot: used by test_supervisor.py."""

from msgspec.structs import replace

from disco_hw.runtime import State
from disco_hw.runtime.supervisor import Inputs, Supervisor, SupervisorSettings, UserRequest
from drivers.types import DriverState, LinkState, Request

SETTINGS = SupervisorSettings(telemetry_zero_s=0.05, telemetry_disarm_s=0.15, pose_required=True)
TICK_NS = 20_000_000
ARM, START, STOP = UserRequest.ARM, UserRequest.START, UserRequest.STOP
DISARM, ESTOP, RESET = UserRequest.DISARM, UserRequest.ESTOP, UserRequest.RESET


class Bench:
    """A supervisor with a stand-in for the robot, which obeys each request within one tick."""

    def __init__(self, settings=SETTINGS):
        self.supervisor = Supervisor(settings)
        self.now_ns = 0
        self.robot_obeys = True
        self.events = []
        self.requests_sent = []
        self.inputs = Inputs(
            link_state=LinkState.UP,
            link_generation=1,
            driver_state=DriverState.HANDSHAKE,
            driver_detail="detail of the driver",
            telemetry_age_s=0.01,
            wheel_speed_rad_s=0.0,
            pose_ok=True,
        )
        self.out = None

    def tick(self, *requests, count=1, **changes):
        self.inputs = replace(self.inputs, **changes)
        for index in range(count):
            tick_requests = requests if index == 0 else ()
            self.out = self.supervisor.step(self.now_ns, replace(self.inputs, requests=tick_requests))
            self.now_ns += TICK_NS
            self.events += self.out.events
            if self.out.driver_request is not None:
                self.requests_sent.append(self.out.driver_request)
            if self.robot_obeys:
                self._obey()
        return self.out

    def _obey(self):
        request, robot = self.out.driver_request, self.inputs.driver_state
        if self.out.send_estop:
            robot = DriverState.ESTOP
        elif robot is DriverState.HANDSHAKE:
            robot = DriverState.STANDBY
        elif robot is DriverState.ARMING:
            robot = DriverState.ARMED
        elif robot in {DriverState.ESTOP, DriverState.FAULT}:
            robot = DriverState.STANDBY if request is Request.RESET else robot
        elif robot is DriverState.ARMED and request in {Request.STANDBY, Request.READY}:
            robot = DriverState.STOPPING
        elif robot is DriverState.STOPPING:
            robot = DriverState.STANDBY
        elif robot in {DriverState.STANDBY, DriverState.READY} and request is not None:
            robot = DriverState.ARMING if request is Request.ARM else DriverState(request.value)
        self.inputs = replace(self.inputs, driver_state=robot)

    def connected(self):
        self.tick(driver_state=DriverState.HANDSHAKE)
        assert self.out.state is State.HANDSHAKE
        return self

    def ready(self):
        self.tick(count=4)
        assert self.out.state is State.READY
        return self

    def arming(self):
        self.ready().robot_obeys = False
        self.tick(ARM)
        self.tick(driver_state=DriverState.ARMING)
        assert self.out.state is State.READY
        return self

    def armed(self):
        self.ready().tick(ARM)
        self.tick(count=3)
        assert self.out.state is State.ARMED
        return self

    def running(self):
        self.armed().tick(START)
        assert self.out.motion_allowed
        return self

    def faulted(self):
        self.ready().tick(ESTOP)
        self.tick(count=2)
        assert self.out.state is State.FAULT
        assert self.inputs.driver_state is DriverState.ESTOP
        return self

    def stopping(self):
        self.running().robot_obeys = False
        self.tick(DISARM)
        assert self.out.state is State.STOPPING
        return self
