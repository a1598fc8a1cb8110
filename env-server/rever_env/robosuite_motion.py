"""Motion of one arm in robosuite: actions in metres and radians move the commanded pose."""

from typing import Any

# Arms with measured moves: after five steps of 10 mm or 0.1 rad and 2 s of rest they have moved by
# 50 mm or 0.5 rad within MOVE_TOLERANCE. IIWA (110 % more) and XArm7 (23 %) do not qualify.
ARMS_TO_SCALE = ("Jaco", "Kinova3", "Panda", "Sawyer", "UR5e")
MOVE_TOLERANCE = 0.1
# The same for the arm of the Bridge tasks, whose joints have no friction. The tolerance covers the
# joint limit of the wrist, which a pitch of 0.5 rad over the sink reaches.
BRIDGE_MOVE_TOLERANCE = 0.03


def is_moved_by_pose(robot: Any) -> bool:
    """Whether the robot's controller accepts changes of the gripper pose in the base frame."""
    arm = robot.part_controllers[robot.arms[0]]
    return bool(
        arm.name == "OSC_POSE" and arm.input_type == "delta" and arm.input_ref_frame == "base"
    )


def move_commanded_pose(robot: Any) -> None:
    """Makes actions move the commanded pose, which starts at the measured one. Call after a reset.

    By default each action starts from the measured pose, so that the arm's lag is lost: a Panda
    that is commanded to move 50 mm at 20 Hz moves 12 mm. robosuite 1.5.2 has a mode for it, but
    ignores goal_update_mode in a controller's configuration, and its reset leaves a goal in the
    world frame although the controller reads it in the base frame.
    """
    robot.composite_controller.update_state()
    arm = robot.part_controllers[robot.arms[0]]
    arm.update(force=True)
    pose = arm.goal_origin_to_eef_pose()  # in the base frame
    arm.goal_pos, arm.goal_ori = pose[:3, 3].copy(), pose[:3, :3].copy()
    arm.set_goal_update_mode("desired")
