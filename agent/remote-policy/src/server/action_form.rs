//! The convention of the actions that a server sends. This project's own is that of SIMPLER's WidowX
//! tasks: translation, rotation vector, gripper +1 open or -1 closed.

use anyhow::{Result, ensure};
use decision::ActionSpace;

/// Translation, rotation, gripper.
const BRIDGE_DIMENSIONS: usize = 7;

/// How rotations and gripper commands are written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ActionForm {
    /// Numbers 3 to 5 of an action.
    pub rotation: Rotation,
    /// The last number of an action.
    pub gripper: Gripper,
}

/// How a rotation is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Rotation {
    /// Axis times angle in radians.
    #[default]
    Vector,
    /// Roll about x, then pitch about y, then yaw about z, in radians, about fixed axes.
    Euler,
}

/// How a gripper command is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Gripper {
    /// +1 opens, -1 closes: SIMPLER's WidowX.
    #[default]
    OpenPositive,
    /// -1 opens, +1 closes: LIBERO.
    ClosePositive,
    /// 1 opens, 0 closes: the Bridge data set, vla-eval's Google robot.
    OpenOne,
}

impl ActionForm {
    /// Refuses a conversion of actions that do not have a Bridge action's dimensions.
    pub fn check(self, space: &ActionSpace) -> Result<()> {
        let is_bridge =
            space.length() == BRIDGE_DIMENSIONS && space.gripper == Some(BRIDGE_DIMENSIONS - 1);
        ensure!(
            self == ActionForm::default() || is_bridge,
            "rotation and gripper: expected a policy with actions of {BRIDGE_DIMENSIONS} numbers, the last for the \
             gripper, got {} numbers",
            space.length()
        );
        Ok(())
    }

    /// An action in this form.
    pub fn convert(self, action: &[f32]) -> Vec<f32> {
        let mut action = action.to_vec();
        let [_, _, _, x, y, z, gripper] = &mut action[..] else { return action };
        if self.rotation == Rotation::Euler {
            let angles = euler([*x, *y, *z].map(f64::from));
            [*x, *y, *z] = angles.map(|angle| angle as f32);
        }
        let opens = *gripper > 0.0;
        match self.gripper {
            Gripper::OpenPositive => {}
            Gripper::ClosePositive => *gripper = if opens { -1.0 } else { 1.0 },
            Gripper::OpenOne => *gripper = if opens { 1.0 } else { 0.0 },
        }
        action
    }
}

/// Roll, pitch and yaw of a rotation vector.
fn euler([x, y, z]: [f64; 3]) -> [f64; 3] {
    let angle = (x * x + y * y + z * z).sqrt();
    // Near zero, sin(angle / 2) / angle approaches 1/2.
    let factor = if angle < 1e-9 { 0.5 } else { (angle / 2.0).sin() / angle };
    let (w, x, y, z) = ((angle / 2.0).cos(), x * factor, y * factor, z * factor);
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    [roll, pitch, yaw]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn euler_angles_are_those_of_scipy() {
        // scipy.spatial.transform.Rotation.from_rotvec([0.3, -0.2, 0.5]).as_euler("xyz")
        let expected = [0.243_635_36, -0.263_257, 0.473_004_43];
        for (angle, expected) in euler([0.3, -0.2, 0.5]).into_iter().zip(expected) {
            assert!((angle - expected).abs() < 1e-7, "expected {expected}, got {angle}");
        }
        assert_eq!(euler([0.0; 3]), [0.0; 3]);
    }

    #[test]
    fn the_gripper_has_three_conventions_and_the_default_changes_nothing() {
        let action = [0.01, 0.02, 0.03, 0.1, 0.2, 0.3, -1.0];
        assert_eq!(ActionForm::default().convert(&action), action);
        for (gripper, closed, open) in [
            (Gripper::OpenPositive, -1.0, 1.0),
            (Gripper::ClosePositive, 1.0, -1.0),
            (Gripper::OpenOne, 0.0, 1.0),
        ] {
            let form = ActionForm { gripper, ..ActionForm::default() };
            assert_eq!(form.convert(&action)[6], closed);
            assert_eq!(form.convert(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])[6], open);
            assert_eq!(form.convert(&action)[..6], action[..6]);
        }
    }
}
