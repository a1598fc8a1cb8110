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

/// Roll, pitch and yaw of a rotation vector: the inverse of [`rotation_vector`] for pitches of at
/// most a quarter turn.
pub fn roll_pitch_yaw(vector: [f64; 3]) -> [f64; 3] {
    let angle = vector.iter().map(|number| number * number).sum::<f64>().sqrt();
    // Near zero, sin(angle / 2) / angle approaches 1 / 2.
    let factor = if angle < 1e-9 { 0.5 } else { (angle / 2.0).sin() / angle };
    let ([x, y, z], w) = (vector.map(|number| number * factor), (angle / 2.0).cos());
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - x * z)).clamp(-1.0, 1.0).asin();
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    [roll, pitch, yaw]
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
    fn angles_and_vectors_are_inverse() {
        for angles in [[0.0; 3], [0.1, -0.2, 0.3], [-2.0, 1.2, 3.0], [1e-10, 0.0, -1e-10]] {
            let [roll, pitch, yaw] = angles;
            for (got, expected) in
                roll_pitch_yaw(rotation_vector(roll, pitch, yaw)).iter().zip(angles)
            {
                assert!((got - expected).abs() < 1e-12, "{got}, expected {expected}");
            }
        }
    }

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
