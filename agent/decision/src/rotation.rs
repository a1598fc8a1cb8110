//! Conversions between descriptions of a rotation.

/// The rotation vector of a rotation about the fixed axes: roll about x, then pitch about y, then
/// yaw about z.
pub fn rotation_vector(roll: f64, pitch: f64, yaw: f64) -> [f64; 3] {
    let [w, axis @ ..] = quaternion(roll, pitch, yaw);
    let sine = axis.iter().map(|number| number * number).sum::<f64>().sqrt();
    // Near zero, angle / sin(angle / 2) approaches 2.
    let factor = if sine < 1e-9 { 2.0 } else { 2.0 * sine.atan2(w) / sine };
    axis.map(|number| number * factor)
}

/// The unit quaternion (w, x, y, z) of the same rotation; w is not negative.
pub fn quaternion(roll: f64, pitch: f64, yaw: f64) -> [f64; 4] {
    let (sr, cr) = (roll / 2.0).sin_cos();
    let (sp, cp) = (pitch / 2.0).sin_cos();
    let (sy, cy) = (yaw / 2.0).sin_cos();
    let quaternion = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ];
    // The negative is the same rotation; this one has the smaller angle.
    if quaternion[0] < 0.0 { quaternion.map(|number| -number) } else { quaternion }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn a_turn_about_one_axis_is_its_angle() {
        assert_eq!(rotation_vector(0.0, 0.0, 0.0), [0.0; 3]);
        for axis in 0..3 {
            let mut angles = [0.0; 3];
            angles[axis] = FRAC_PI_2;
            let [roll, pitch, yaw] = angles;
            for (got, expected) in rotation_vector(roll, pitch, yaw).iter().zip(angles) {
                assert!((got - expected).abs() < 1e-12, "{got}, expected {expected}");
            }
            let [w, ..] = quaternion(roll, pitch, yaw);
            assert!((w - (FRAC_PI_2 / 2.0).cos()).abs() < 1e-12);
        }
    }
}
