"""What the robot is to do: one file a kind of task (docs/add-a-task.md says what such a file holds)."""

from disco_hw.tasks.registry import ReadField, UnknownKind, default_task, kind_of, kinds, task_class, task_from
from disco_hw.tasks.task import Course, PlannedTask, Prepared, Progress, RobotTask, TaskFault

__all__ = [
    "Course",
    "PlannedTask",
    "Prepared",
    "Progress",
    "ReadField",
    "RobotTask",
    "TaskFault",
    "UnknownKind",
    "default_task",
    "kind_of",
    "kinds",
    "task_class",
    "task_from",
]
