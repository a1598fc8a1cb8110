//! Object positions estimated from the reasoning of an episode so far.
//!
//! Every candidate's reasoning names bounding boxes. A single box is a few pixels off, and more if
//! the gripper covers the object. Objects do not move until they are touched, so the mean of all
//! boxes so far is much more precise than any single one.

use crate::Reasoning;

/// Left, top, right, bottom in an image of 256 x 256 pixels.
pub type BoundingBox = [f32; 4];

/// Number of stages of a manipulation task, each with a target object.
pub const STAGES: usize = 2;

/// A box is an outlier if one of its sides is farther than this from the median, in pixels.
/// Outliers do not enter the mean.
const OUTLIER_PIXELS: f32 = 24.0;
/// After this number of consecutive steps about grasping again, the object counts as dropped at
/// another position.
const DROPPED_STEPS: u32 = 2;

/// The stage of a manipulation task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// The target is the first object of the reasoning, which has to be moved.
    Grasp,
    /// The target is the second object, the destination of the first.
    Place,
}

impl Stage {
    /// All stages, in the order of a task.
    pub const ALL: [Stage; STAGES] = [Stage::Grasp, Stage::Place];

    /// The stage by the first word of `SUBTASK:`, or `None` if it has no target object.
    fn of(subtask: &str) -> Option<Stage> {
        match subtask.split_whitespace().next()? {
            "reach" | "grasp" => Some(Stage::Grasp),
            "lift" | "move" | "release" => Some(Stage::Place),
            _ => None,
        }
    }
}

/// What one candidate's reasoning says about the objects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReasoningFeatures {
    /// The stage of the candidate's current subtask.
    pub stage: Option<Stage>,
    /// The box of each stage's target object.
    pub bounds: [BoundingBox; STAGES],
}

impl ReasoningFeatures {
    /// `None` if the reasoning does not name two objects.
    pub fn of(reasoning: &Reasoning) -> Option<ReasoningFeatures> {
        let [first, second, ..] = reasoning.visible_objects.as_slice() else { return None };
        let bounds = [first, second].map(|object| object.bounding_box.map(f32::from));
        Some(ReasoningFeatures { stage: Stage::of(&reasoning.subtask), bounds })
    }
}

/// The estimates of an episode so far.
#[derive(Clone, Debug, Default)]
pub struct ObjectTracker {
    said: [Vec<BoundingBox>; STAGES],
    is_placing: bool,
    grasping_steps: u32,
}

/// The combined estimate from the reasoning of this and all previous steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackedObjects {
    /// The stage of most candidates.
    pub stage: Option<Stage>,
    /// The box of each stage's target object.
    pub bounds: [Option<BoundingBox>; STAGES],
}

impl ObjectTracker {
    /// Updates the estimate with the candidates' reasoning at one step.
    pub fn note(&mut self, said: &[ReasoningFeatures]) -> TrackedObjects {
        let count = |stage| said.iter().filter(|one| one.stage == stage).count();
        let stages = [None, Some(Stage::Place), Some(Stage::Grasp)];
        let stage = stages.into_iter().filter(|stage| count(*stage) > 0);
        let stage = stage.max_by_key(|stage| count(*stage)).flatten();
        match stage {
            Some(Stage::Grasp) => {
                self.grasping_steps += 1;
                if self.is_placing && self.grasping_steps >= DROPPED_STEPS {
                    self.is_placing = false;
                    self.said[0].clear();
                }
            }
            Some(Stage::Place) => {
                self.is_placing = true;
                self.grasping_steps = 0;
            }
            None => {}
        }
        if !said.is_empty() {
            let boxes = |stage: usize| said.iter().map(|one| one.bounds[stage]).collect();
            // The object does not move while it is being grasped; once it is held it moves with the
            // gripper.
            if stage == Some(Stage::Grasp) && !self.is_placing {
                self.said[0].push(median(boxes(0)));
            }
            self.said[1].push(median(boxes(1)));
        }
        TrackedObjects { stage, bounds: [0, 1].map(|stage| mean(&self.said[stage])) }
    }
}

/// The median of each side.
fn median(boxes: Vec<BoundingBox>) -> BoundingBox {
    std::array::from_fn(|side| {
        let mut values: Vec<f32> = boxes.iter().map(|bounds| bounds[side]).collect();
        values.sort_by(f32::total_cmp);
        let (low, high) = ((values.len() - 1) / 2, values.len() / 2);
        (values[low] + values[high]) / 2.0
    })
}

/// The mean of the boxes that are near their median.
fn mean(boxes: &[BoundingBox]) -> Option<BoundingBox> {
    if boxes.is_empty() {
        return None;
    }
    let middle = median(boxes.to_vec());
    let is_near = |bounds: &&BoundingBox| {
        bounds.iter().zip(middle).all(|(side, middle)| (side - middle).abs() <= OUTLIER_PIXELS)
    };
    let near: Vec<&BoundingBox> = boxes.iter().filter(is_near).collect();
    if near.is_empty() {
        return Some(middle);
    }
    let mean =
        |side: usize| near.iter().map(|bounds| bounds[side]).sum::<f32>() / near.len() as f32;
    Some(std::array::from_fn(mean))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(stage: Option<Stage>, first: f32, second: f32) -> ReasoningFeatures {
        let bounds = |left: f32| [left, 50.0, left + 10.0, 70.0];
        ReasoningFeatures { stage, bounds: [bounds(first), bounds(second)] }
    }

    const GRASP: Option<Stage> = Some(Stage::Grasp);
    const PLACE: Option<Stage> = Some(Stage::Place);

    #[test]
    fn what_stands_still_is_averaged_without_outliers() {
        let mut tracker = ObjectTracker::default();
        tracker.note(&[said(GRASP, 100.0, 150.0), said(GRASP, 104.0, 150.0)]);
        tracker.note(&[
            said(GRASP, 106.0, 200.0),
            said(None, 106.0, 152.0),
            said(GRASP, 250.0, 152.0),
        ]);
        let tracked = tracker.note(&[said(GRASP, 10.0, 154.0)]);
        assert_eq!(tracked.stage, GRASP);
        // The first object's medians are 102, 106 and 10, of which 10 is an outlier; the second
        // object's are 150, 152 and 154.
        assert_eq!(tracked.bounds[0], Some([104.0, 50.0, 114.0, 70.0]));
        assert_eq!(tracked.bounds[1], Some([152.0, 50.0, 162.0, 70.0]));
        // No candidate is well formed: the boxes do not change and there is no stage.
        let tracked = tracker.note(&[]);
        assert_eq!((tracked.stage, tracked.bounds[0]), (None, Some([104.0, 50.0, 114.0, 70.0])));
    }

    #[test]
    fn what_is_carried_is_remembered_where_it_was_and_forgotten_when_dropped() {
        let mut tracker = ObjectTracker::default();
        let left = |tracked: TrackedObjects| tracked.bounds[0].map(|bounds| bounds[0]);
        tracker.note(&[said(GRASP, 100.0, 150.0)]);
        assert_eq!(left(tracker.note(&[said(PLACE, 130.0, 150.0)])), Some(100.0));
        // A single contradicting step may be an error.
        assert_eq!(left(tracker.note(&[said(GRASP, 140.0, 150.0)])), Some(100.0));
        assert_eq!(left(tracker.note(&[said(GRASP, 144.0, 150.0)])), Some(144.0));
        let tracked = tracker.note(&[said(GRASP, 146.0, 150.0), said(None, 146.0, 150.0)]);
        assert_eq!((tracked.stage, left(tracked)), (GRASP, Some(145.0)));
    }

    #[test]
    fn stages_are_read_off_the_subtask() {
        let reasoning = |subtask: &str, objects: usize| {
            let one = |left: u16| crate::VisibleObject {
                name: "thing".to_owned(),
                bounding_box: [left, 2, 30, 4],
            };
            Reasoning {
                subtask: subtask.to_owned(),
                visible_objects: (0..objects as u16).map(one).collect(),
                ..Reasoning::default()
            }
        };
        let stage =
            |subtask| ReasoningFeatures::of(&reasoning(subtask, 2)).and_then(|said| said.stage);
        assert_eq!(["reach the spoon", "grasp the spoon"].map(stage), [GRASP; 2]);
        assert_eq!(["lift the spoon", "move it", "release it"].map(stage), [PLACE; 3]);
        assert_eq!(stage("stay away"), None);
        assert_eq!(ReasoningFeatures::of(&reasoning("reach it", 1)), None);
        let said =
            ReasoningFeatures::of(&reasoning("reach it", 3)).expect("two objects and one more");
        assert_eq!(said.bounds, [[0.0, 2.0, 30.0, 4.0], [1.0, 2.0, 30.0, 4.0]]);
    }
}
