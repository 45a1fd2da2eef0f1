import numpy as np
import pytest

from disco_hw.adaptation.adapter_link import Samples
from disco_hw.adaptation.recursive import SampleWindow
from disco_hw.inference.excitation import UnusableDriveError
from tools.adaptation_drives import messages


def filled(sent, length_s=1e4):
    window = SampleWindow(length_s)
    for message in sent:
        window.add(message)
    return window


def test_late_and_repeated_poses_are_put_in_order():
    sent = messages(8.0)
    poses = [pose for message in sent for pose in message.poses]
    # Every pose comes twice, and each pair of neighbours the wrong way round.
    swapped = [pose for k in range(0, len(poses), 2) for pose in (*poses[k : k + 2][::-1], poses[k])]
    late = [Samples(m.now_ns, m.wheels, tuple(swapped[3 * k // 4 : 3 * (k + 1) // 4])) for k, m in enumerate(sent)]
    assert filled(late).drive().pose.tolist() == filled(sent).drive().pose.tolist()


def test_only_the_last_seconds_are_kept():
    drive = filled(messages(20.0), 6.0).drive()
    assert drive.t_s[-1] - drive.t_s[0] == pytest.approx(6.0, abs=0.2)


def test_nothing_is_predicted_across_a_gap():
    sent = messages(20.0)
    drive = filled(sent[:400] + sent[500:]).drive()
    assert len(drive.run_pose) == 3
    assert np.count_nonzero(drive.starts) == 2


def test_too_little_is_no_drive():
    with pytest.raises(UnusableDriveError):
        SampleWindow(10.0).drive()
