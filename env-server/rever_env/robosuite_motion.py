"""Motion of one arm in robosuite: actions of metres and radians move the commanded pose."""

from typing import Any

# Arms whose moves were measured: after five steps of 10 mm or 0.1 rad and 2 s of rest they have
# moved by 50 mm or 0.5 rad within MOVE_TOLERANCE. IIWA (110 % more) and XArm7 (23 %) have not.
ARMS_TO_SCALE = ("Jaco", "Kinova3", "Panda", "Sawyer", "UR5e")
MOVE_TOLERANCE = 0.1
# The same for the Bridge tasks' arm, whose joints have no friction here as in our own worlds. It
# covers the wrist's joint limit, which a pitch of 0.5 rad over the sink reaches.
BRIDGE_MOVE_TOLERANCE = 0.03


def is_moved_by_pose(robot: Any) -> bool:
    """Whether the robot's controller takes changes of the gripper's pose in the base's frame."""
    arm = robot.part_controllers[robot.arms[0]]
    return bool(
        arm.name == "OSC_POSE" and arm.input_type == "delta" and arm.input_ref_frame == "base"
    )


def move_commanded_pose(robot: Any) -> None:
    """Lets actions move the commanded pose, which starts at the measured one; after each reset.

    Otherwise every action starts from the measured pose, and what the arm lags behind is lost: of
    50 mm a Panda moves 12 at 20 Hz. robosuite 1.5.2 knows a mode for it, does not read the
    controller's goal_update_mode, and a reset leaves a goal in the frame of the world.
    """
    robot.composite_controller.update_state()
    arm = robot.part_controllers[robot.arms[0]]
    arm.update(force=True)
    pose = arm.goal_origin_to_eef_pose()  # in the base's frame
    arm.goal_pos, arm.goal_ori = pose[:3, 3].copy(), pose[:3, :3].copy()
    arm.set_goal_update_mode("desired")
