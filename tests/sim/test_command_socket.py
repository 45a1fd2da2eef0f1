import select
import socket
import threading

import pytest

from drivers.private_files import SocketPathError
from sim.process import CommandSocket, main, send_command


@pytest.fixture
def commands(tmp_path):
    served = CommandSocket(tmp_path / "commands")
    yield served
    served.close()


def serve_in_thread(commands, execute):
    def run():
        select.select([commands], [], [], 30)
        commands.serve(execute)

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def test_a_command_is_executed_and_answered(tmp_path, commands):
    seen = []
    thread = serve_in_thread(commands, lambda text: (seen.append(text), f"done {text}")[1])
    assert send_command(tmp_path / "commands", "  estop_button on\n") == "done estop_button on"
    thread.join()
    assert seen == ["estop_button on"]


def test_without_a_command_nothing_happens(commands):
    commands.serve(lambda text: pytest.fail("nothing was sent"))


@pytest.mark.parametrize("has_address", [False, True], ids=["wants no answer", "does not take it"])
def test_an_answer_that_nobody_takes_is_lost(tmp_path, commands, has_address):
    seen = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        if has_address:
            client.bind(str(tmp_path / "client"))
        for command in (b"a", b"\xff"):
            client.sendto(command, str(tmp_path / "commands"))
    commands.serve(lambda text: (seen.append(text), "ok")[1])
    assert seen == ["a", "\N{REPLACEMENT CHARACTER}"]


def test_a_taken_path_is_reported(tmp_path, commands):
    with pytest.raises(SocketPathError):
        CommandSocket(tmp_path / "commands")


def test_close_removes_the_socket_and_may_be_repeated(tmp_path, commands):
    commands.close()
    commands.close()
    assert not (tmp_path / "commands").exists()
    with pytest.raises(OSError, match="No such file"):
        send_command(tmp_path / "commands", "state")


def test_the_command_line_sends_one_command(tmp_path, commands, capsys):
    path = str(tmp_path / "commands")
    for reply, code in (("ok", 0), ("error: no", 1)):
        thread = serve_in_thread(commands, lambda text: f"{reply} {text}")  # noqa: B023
        assert main([path, "reboot", "watchdog"]) == code
        thread.join()
        assert capsys.readouterr().out == f"{reply} reboot watchdog\n"
    assert main([str(tmp_path / "none"), "reboot"]) == 1
    assert "is the virtual robot running" in capsys.readouterr().err
    assert main([path]) == 2
