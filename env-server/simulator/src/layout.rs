//! Initial layouts: the 24 layouts of the published grid, and random ones with a distance from
//! them.

use protocol::limits::SEED_END;

use crate::fault::Fault;
use crate::tasks::{Layout, Pose, Task};

const DRAWS_MAX: usize = 10_000;

/// The generator by Steele, Lea and Flood: one 64-bit word of state, the same in every language.
struct SplitMix64 {
    state: u64,
}

impl SplitMix64 {
    fn next_word(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let word = self.state;
        let word = (word ^ (word >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let word = (word ^ (word >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        word ^ (word >> 31)
    }

    /// low + (high - low) u, with u in [0, 1) in steps of 2^-53.
    fn uniform(&mut self, [low, high]: [f64; 2]) -> f64 {
        low + (high - low) * ((self.next_word() >> 11) as f64 / (1u64 << 53) as f64)
    }
}

/// The initial layout of a reset: a grid layout, or a random one from the seed.
pub fn place(task: &Task, layout: Option<u32>, seed: u64) -> Result<Layout, Fault> {
    if seed >= SEED_END {
        return Err(Fault::Wrong(format!("seed {seed}: expected 0 <= seed < 2^53")));
    }
    let Some(layout) = layout else { return draw(task, seed) };
    let layouts = &task.rule.grid.layouts;
    layouts.get(layout as usize).cloned().ok_or_else(|| {
        Fault::Wrong(format!(
            "layout {layout}: expected 0 <= layout < {} for task {}",
            layouts.len(),
            task.id.task
        ))
    })
}

fn draw(task: &Task, seed: u64) -> Result<Layout, Fault> {
    let ranges = &task.rule.random;
    let mut generator = SplitMix64 { state: fnv1a(&task.id.task) ^ seed };
    for _ in 0..DRAWS_MAX {
        let mut layout = Layout {
            source_x: generator.uniform(ranges.source_x),
            source_y: generator.uniform(ranges.source_y),
            source_yaw: generator.uniform(ranges.source_yaw),
            target_x: generator.uniform(ranges.target_x),
            target_y: generator.uniform(ranges.target_y),
            distractors: Vec::new(),
        };
        let apart = distance(layout.source_x - layout.target_x, layout.source_y - layout.target_y);
        if apart >= ranges.separation_min && !is_near_grid_layout(task, &layout) {
            // Distractors are drawn last, so that source and target are the same as without
            // distractors.
            layout.distractors = draw_distractors(task, &layout, &mut generator, seed)?;
            return Ok(layout);
        }
    }
    Err(Fault::Wrong(format!("task {}, seed {seed}: no free layout in {DRAWS_MAX} draws", task.id)))
}

fn draw_distractors(
    task: &Task,
    layout: &Layout,
    generator: &mut SplitMix64,
    seed: u64,
) -> Result<Vec<Pose>, Fault> {
    let mut placed = vec![(layout.source_x, layout.source_y), (layout.target_x, layout.target_y)];
    let mut poses = Vec::new();
    for distractor in &task.rule.distractors {
        let mut draw = || Pose {
            x: generator.uniform(distractor.x),
            y: generator.uniform(distractor.y),
            yaw: generator.uniform(distractor.yaw),
        };
        let is_free = |pose: &Pose| {
            let clear = |&(x, y)| distance(pose.x - x, pose.y - y) >= distractor.separation_min;
            placed.iter().all(clear)
        };
        let pose = std::iter::repeat_with(&mut draw).take(DRAWS_MAX).find(is_free);
        let pose = pose.ok_or_else(|| {
            Fault::Wrong(format!(
                "task {}, seed {seed}: no free place for the {} in {DRAWS_MAX} draws",
                task.id, distractor.body
            ))
        })?;
        placed.push((pose.x, pose.y));
        poses.push(pose);
    }
    Ok(poses)
}

/// Whether source, target and yaw are all within the exclusion distances of one grid layout.
fn is_near_grid_layout(task: &Task, layout: &Layout) -> bool {
    let ranges = &task.rule.random;
    let radius = ranges.exclusion_radius;
    task.rule.grid.layouts.iter().any(|grid| {
        distance(layout.source_x - grid.source_x, layout.source_y - grid.source_y) <= radius
            && distance(layout.target_x - grid.target_x, layout.target_y - grid.target_y) <= radius
            && turn(layout.source_yaw - grid.source_yaw) <= ranges.exclusion_yaw
    })
}

/// 64-bit FNV-1a: mixes the task's name into the stream, so that tasks have different random
/// numbers.
fn fnv1a(text: &str) -> u64 {
    let mix = |digest: u64, byte| (digest ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3);
    text.bytes().fold(0xCBF2_9CE4_8422_2325, mix)
}

fn distance(x: f64, y: f64) -> f64 {
    // Square root of plain products: it is correctly rounded and thus equal in every language,
    // unlike hypot.
    (x * x + y * y).sqrt()
}

/// The angle between two headings, 0 to 180 degrees.
fn turn(degrees: f64) -> f64 {
    let wrapped = degrees.abs() % 360.0;
    wrapped.min(360.0 - wrapped)
}
