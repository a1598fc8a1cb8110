//! The scripted expert, without its reasoning. The server reports its actions in sessions opened
//! with `expert`.
//!
//! It picks up the source and puts it on the target, using only visible state, as
//! `rever_env/expert.py` does.

use mujoco_rs::wrappers::fun::utility::mju_mul_mat_t_vec;

use crate::model::Vector;
use crate::success::norm;
use crate::tasks::TaskRule;

/// Share of the remaining distance that one action covers.
const GAIN: f64 = 0.6;
/// Maximum translation in metres per step.
const MOVE_MAX: f64 = 0.035;
/// Maximum rotation in radians per step.
const TURN_MAX: f64 = 0.25;
/// Height in metres allowed per metre of horizontal error: a funnel above the goal.
const SLOPE: f64 = 3.0;
/// Horizontal tolerance in metres for the final descent.
const REACH_TOLERANCE: f64 = 0.005;
/// Tolerance in metres for starting to close the gripper.
const CLOSE_TOLERANCE: f64 = 0.008;
/// Tolerance in metres for continuing to close a gripper that is visibly closing.
const KEEP_CLOSING_TOLERANCE: f64 = 0.015;
/// Rise in metres per step while the fingers are visibly closing.
const RISE_WHILE_CLOSING: f64 = 0.006;
/// Height in metres above the grasp at which closed fingers have missed the source.
const RISEN_MAX: f64 = 0.025;
const PLACE_TOLERANCE: f64 = 0.006;
const HEIGHT_TOLERANCE: f64 = 0.006;
/// Tolerance in radians.
const TURN_TOLERANCE: f64 = 0.15;
/// Weight of a rotation error relative to a horizontal error in the funnel.
const METRES_PER_RADIAN: f64 = 0.04;
/// Finger joint position in metres from which the gripper counts as open.
const OPEN_MIN: f64 = 0.034;

/// The state that the expert uses, in the world frame, in metres and radians.
pub struct Sight {
    pub tcp: Vector,
    /// Heading of the finger axis.
    pub finger_angle: f64,
    /// Mean finger joint position.
    pub finger_opening: f64,
    /// Origin of the source.
    pub source: Vector,
    /// Centre of mass of the source.
    pub source_centre: Vector,
    pub source_angle: f64,
    pub target_centre: Vector,
    pub target_origin: Vector,
    pub held: bool,
    pub on_target: bool,
    pub world_from_base: [f64; 9],
}

/// The expert's action; a pure function of the state.
pub fn decide(rule: &TaskRule, sight: &Sight) -> [f64; 7] {
    if sight.held {
        carry(rule, sight)
    } else if sight.on_target {
        leave(rule, sight)
    } else {
        fetch(rule, sight)
    }
}

/// Angle in rad from the finger axis to the source's short side, given the source's symmetry. The
/// interval is asymmetric, so that a source that lies across is always turned in the same
/// direction.
fn turn_error(rule: &TaskRule, sight: &Sight) -> f64 {
    let period = rule.grasp_symmetry.to_radians();
    let error = sight.source_angle + std::f64::consts::PI / 2.0 - sight.finger_angle;
    modulo(error + period / 3.0, period) - period / 3.0
}

/// Moves above the source, descends in the funnel, and closes the gripper.
fn fetch(rule: &TaskRule, sight: &Sight) -> [f64; 7] {
    let turned = turned(&rule.grasp_offset, sight.source_angle);
    let goal: Vector = std::array::from_fn(|axis| sight.source[axis] + turned[axis]);
    let away = norm(&[goal[0] - sight.tcp[0], goal[1] - sight.tcp[1]]);
    let turn = turn_error(rule, sight);
    let above = sight.tcp[2] - goal[2];
    let is_open = sight.finger_opening >= OPEN_MIN;
    let tolerance = if is_open { CLOSE_TOLERANCE } else { KEEP_CLOSING_TOLERANCE };
    let risen_max = if is_open { HEIGHT_TOLERANCE } else { RISEN_MAX };
    if away <= tolerance
        && (-HEIGHT_TOLERANCE..=risen_max).contains(&above)
        && turn.abs() <= TURN_TOLERANCE
    {
        let rise = if is_open { 0.0 } else { RISE_WHILE_CLOSING / GAIN };
        return action(sight, [0.0, 0.0, rise], 0.0, -1.0);
    }
    let error = away.max(METRES_PER_RADIAN * turn.abs());
    let mut height = rule.hover.min(SLOPE * (error - REACH_TOLERANCE).max(0.0));
    if !is_open {
        // Open again before descending.
        height = height.max(rule.hover / 2.0);
    }
    // Below the funnel the fingers could push the source away: rise before moving sideways.
    let low = (height - above).max(0.0);
    let sideways = fade(low, 0.015, 0.04);
    let way = [
        (goal[0] - sight.tcp[0]) * sideways,
        (goal[1] - sight.tcp[1]) * sideways,
        goal[2] + height - sight.tcp[2],
    ];
    action(sight, way, turn, 1.0)
}

/// Lifts the source, moves above the target, descends in the funnel, and opens the gripper.
fn carry(rule: &TaskRule, sight: &Sight) -> [f64; 7] {
    let rest = sight.target_origin[2] + rule.target_top + rule.source_bottom;
    let place = rest + rule.release_gap;
    let away = [0, 1].map(|axis: usize| sight.target_centre[axis] - sight.source_centre[axis]);
    let error = norm(&away);
    let above = sight.source[2] - place;
    if error <= PLACE_TOLERANCE + 0.003 && above <= HEIGHT_TOLERANCE {
        return action(sight, [0.0; 3], 0.0, 1.0);
    }
    let carry = rule.hover - rule.release_gap;
    let height = carry.min(SLOPE * (error - PLACE_TOLERANCE).max(0.0));
    let low = (height - above).max(0.0);
    let sideways = fade(low, 0.015, 0.04);
    action(sight, [away[0] * sideways, away[1] * sideways, height - above], 0.0, -1.0)
}

/// Opens the gripper completely, rises, and stays.
fn leave(rule: &TaskRule, sight: &Sight) -> [f64; 7] {
    if sight.finger_opening < OPEN_MIN {
        return action(sight, [0.0; 3], 0.0, 1.0);
    }
    let rise = sight.source[2] + rule.hover - sight.tcp[2];
    let rise = if rise < 0.012 { 0.0 } else { rise };
    action(sight, [0.0, 0.0, rise], 0.0, 1.0)
}

/// Scales the remaining distance to one action in the base frame. Roll and pitch stay zero.
fn action(sight: &Sight, way: Vector, turn: f64, gripper: f64) -> [f64; 7] {
    let mut step = way.map(|way| GAIN * way);
    let length = norm(&step);
    if length > MOVE_MAX {
        step = step.map(|step| step * (MOVE_MAX / length));
    }
    let mut translation = [0.0; 3];
    mju_mul_mat_t_vec(&mut translation, &sight.world_from_base, &step);
    // The base's z axis is the world's z axis.
    let yaw = (GAIN * turn).clamp(-TURN_MAX, TURN_MAX);
    [translation[0], translation[1], translation[2], 0.0, 0.0, yaw, gripper]
}

fn turned([x, y, z]: &Vector, angle: f64) -> Vector {
    let (cosine, sine) = (angle.cos(), angle.sin());
    [cosine * x - sine * y, sine * x + cosine * y, *z]
}

/// 1 up to `full`, 0 from `none`, linear in between.
fn fade(value: f64, full: f64, none: f64) -> f64 {
    ((none - value) / (none - full)).clamp(0.0, 1.0)
}

/// The remainder with the sign of the (positive) period.
fn modulo(value: f64, period: f64) -> f64 {
    let rest = value % period;
    if rest < 0.0 { rest + period } else { rest }
}
