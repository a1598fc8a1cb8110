//! Where the objects are, by what the reasoning of an episode has said so far.
//!
//! Every candidate says where it sees the objects. One such box is a few pixels off, more when the gripper covers the
//! object; but objects stand still until they are touched, so the mean of all boxes so far is much more precise than any
//! of them.

use crate::Reasoning;

/// Left, top, right, bottom in the square of 256 pixels.
pub type BoundingBox = [f32; 4];

/// Stages of a manipulation task that head for a place.
pub const STAGES: usize = 2;

/// A box whose side is farther than this from the median of all is left out of the mean, in pixels.
const OUTLIER_PIXELS: f32 = 24.0;
/// Steps in a row that must be about grasping again before the object counts as dropped elsewhere.
const DROPPED_STEPS: u32 = 2;

/// What the gripper heads for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// The first object of the reasoning, which is to be moved.
    Grasp,
    /// The second one, where the first is to go.
    Place,
}

impl Stage {
    /// In the order of a task.
    pub const ALL: [Stage; STAGES] = [Stage::Grasp, Stage::Place];

    /// By the first word of `SUBTASK:`; none when it heads for nothing.
    fn of(subtask: &str) -> Option<Stage> {
        match subtask.split_whitespace().next()? {
            "reach" | "grasp" => Some(Stage::Grasp),
            "lift" | "move" | "release" => Some(Stage::Place),
            _ => None,
        }
    }
}

/// What a candidate says about the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReasoningFeatures {
    /// The stage that it is in.
    pub stage: Option<Stage>,
    /// Of the object that each stage heads for.
    pub bounds: [BoundingBox; STAGES],
}

impl ReasoningFeatures {
    /// None when the reasoning does not name two objects.
    pub fn of(reasoning: &Reasoning) -> Option<ReasoningFeatures> {
        let [first, second, ..] = reasoning.visible_objects.as_slice() else { return None };
        let bounds = [first, second].map(|object| object.bounding_box.map(f32::from));
        Some(ReasoningFeatures { stage: Stage::of(&reasoning.subtask), bounds })
    }
}

/// What has been said in an episode so far.
#[derive(Clone, Debug, Default)]
pub struct ObjectTracker {
    said: [Vec<BoundingBox>; STAGES],
    is_placing: bool,
    grasping_steps: u32,
}

/// What the reasoning of this step and of all before it says together.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrackedObjects {
    /// The stage that most candidates are in.
    pub stage: Option<Stage>,
    /// Where the object that each stage heads for stands.
    pub bounds: [Option<BoundingBox>; STAGES],
}

impl ObjectTracker {
    /// Takes in what the candidates of one step say.
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
            // What is being grasped stands still; what is held does not.
            if stage == Some(Stage::Grasp) && !self.is_placing {
                self.said[0].push(median(boxes(0)));
            }
            self.said[1].push(median(boxes(1)));
        }
        TrackedObjects { stage, bounds: [0, 1].map(|stage| mean(&self.said[stage])) }
    }
}

/// Side by side.
fn median(boxes: Vec<BoundingBox>) -> BoundingBox {
    std::array::from_fn(|side| {
        let mut values: Vec<f32> = boxes.iter().map(|bounds| bounds[side]).collect();
        values.sort_by(f32::total_cmp);
        let (low, high) = ((values.len() - 1) / 2, values.len() / 2);
        (values[low] + values[high]) / 2.0
    })
}

/// Of the boxes that are near their median.
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
        // Medians 102, 106 and 10 of the first object, of which the last is an outlier; 150, 152 and 154 of the second.
        assert_eq!(tracked.bounds[0], Some([104.0, 50.0, 114.0, 70.0]));
        assert_eq!(tracked.bounds[1], Some([152.0, 50.0, 162.0, 70.0]));
        // No candidate is well formed: nothing new is known, and the gripper heads for nothing.
        let tracked = tracker.note(&[]);
        assert_eq!((tracked.stage, tracked.bounds[0]), (None, Some([104.0, 50.0, 114.0, 70.0])));
    }

    #[test]
    fn what_is_carried_is_remembered_where_it_was_and_forgotten_when_dropped() {
        let mut tracker = ObjectTracker::default();
        let left = |tracked: TrackedObjects| tracked.bounds[0].map(|bounds| bounds[0]);
        tracker.note(&[said(GRASP, 100.0, 150.0)]);
        assert_eq!(left(tracker.note(&[said(PLACE, 130.0, 150.0)])), Some(100.0));
        // One step that says otherwise may be a slip.
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
