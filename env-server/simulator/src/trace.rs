//! The trace subcommand: every number of an episode, so that two simulators can be held beside one another.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, anyhow};
use clap::Args;
use protocol::{Observation, Statistics};
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::tasks::{ACTION_LENGTH, Task};
use crate::world::World;

/// Print every number of an episode: one JSON object for the reset and one for each step
#[derive(Debug, Args)]
#[group(skip)]
pub struct Arguments {
    #[arg(long)]
    task: String,
    /// Drawn from the seed if left out.
    #[arg(long)]
    layout: Option<u32>,
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Height and width of the image.
    #[arg(long, default_value_t = 128)]
    side: u32,
    /// 7 numbers per line; without it the scripted expert acts.
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
}

/// Floats stand as their bits, 16 (or 8) hexadecimal digits.
#[derive(Serialize)]
struct Line {
    qpos: Vec<String>,
    qvel: Vec<String>,
    state: Vec<String>,
    expert_action: Vec<String>,
    image: String,
    statistics: Option<Statistics>,
}

type Action = [f32; ACTION_LENGTH];

/// Runs an episode to its horizon or the actions' end.
pub fn trace(arguments: Arguments, tasks: Vec<Task>) -> Result<()> {
    let task = tasks.into_iter().find(|task| task.name == arguments.task);
    let task = task.with_context(|| format!("there is no task {}", arguments.task))?;
    let mut actions = arguments.actions.map(read).transpose()?.map(Vec::into_iter);
    let mut world = World::new(&Arc::new(task), arguments.side, arguments.side)?;
    let observation = world.reset(arguments.layout, arguments.seed)?;
    print(&world, &observation, None)?;
    loop {
        let action = match &mut actions {
            None => world.expert_action()?,
            Some(actions) => match actions.next() {
                Some(action) => action,
                None => return Ok(()),
            },
        };
        let transition = world.step(&action)?;
        print(&world, &transition.observation, Some(transition.statistics))?;
        if transition.truncated {
            return Ok(());
        }
    }
}

fn read(file: PathBuf) -> Result<Vec<Action>> {
    let text = std::fs::read_to_string(&file)
        .with_context(|| format!("cannot read {}", file.display()))?;
    let action = |line: &str| -> Result<Action> {
        let numbers = line.split_whitespace().map(str::parse).collect::<Result<Vec<f64>, _>>()?;
        let numbers: [f64; ACTION_LENGTH] = numbers.try_into().map_err(|numbers: Vec<f64>| {
            anyhow!("expected {ACTION_LENGTH} numbers, got {}: {line:?}", numbers.len())
        })?;
        Ok(numbers.map(|number| number as f32))
    };
    text.lines().map(action).collect()
}

fn print(world: &World, seen: &Observation, statistics: Option<Statistics>) -> Result<()> {
    let (positions, velocities) = world.joints();
    let wide = |numbers: &[f64]| numbers.iter().map(|number| bits(number.to_bits(), 16)).collect();
    let narrow =
        |numbers: &[f32]| numbers.iter().map(|number| bits(number.to_bits().into(), 8)).collect();
    let digest = Sha256::digest(&seen.image.pixels);
    let line = Line {
        qpos: wide(positions),
        qvel: wide(velocities),
        state: narrow(&seen.state),
        expert_action: narrow(&world.expert_action()?),
        image: digest.iter().map(|byte| format!("{byte:02x}")).collect(),
        statistics,
    };
    println!("{}", serde_json::to_string(&line)?);
    Ok(())
}

fn bits(number: u64, digits: usize) -> String {
    format!("{number:0digits$x}")
}
