//! The trace subcommand: prints all numbers of episodes, to compare two simulators.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, anyhow};
use clap::Args;
use protocol::{Observation, Statistics};
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::tasks::{self, ACTION_LENGTH, Task};
use crate::world::World;

/// Print all numbers of episodes: one JSON object for each reset and each step
#[derive(Debug, Args)]
#[group(skip)]
pub struct Arguments {
    /// Tasks to run: TASK, TASK/VARIANT, TASK/all, or all.
    #[arg(long, num_args = 1.., required = true, value_name = "TASK")]
    tasks: Vec<String>,
    /// Fixed initial layouts; by default, random layouts from the seeds.
    #[arg(long, num_args = 1..)]
    layouts: Vec<u32>,
    /// Seeds of the episodes.
    #[arg(long, num_args = 1.., default_values_t = [0])]
    seeds: Vec<u64>,
    /// Height and width of the image.
    #[arg(long, default_value_t = 128)]
    side: u32,
    /// File with the actions, 7 numbers per line; by default the scripted expert acts.
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
}

/// Floats are represented by their bits as 16 (or 8) hexadecimal digits.
#[derive(Serialize)]
struct Line<'a> {
    episode: &'a str,
    step: u32,
    qpos: Vec<String>,
    qvel: Vec<String>,
    state: Vec<String>,
    expert_action: Vec<String>,
    image: String,
    statistics: Option<Statistics>,
}

type Action = [f32; ACTION_LENGTH];

/// Runs each episode to its horizon or to the end of the actions.
pub fn trace(arguments: Arguments, tasks: Vec<Task>) -> Result<()> {
    let Arguments { layouts, seeds, side, .. } = arguments;
    let actions = arguments.actions.map(read).transpose()?;
    let layouts = match layouts.as_slice() {
        [] => vec![None],
        layouts => layouts.iter().copied().map(Some).collect(),
    };
    for task in tasks::choose(tasks, &arguments.tasks)? {
        let task = Arc::new(task);
        let mut world = World::new(&task, side, side)?;
        for &layout in &layouts {
            for &seed in &seeds {
                let words = layout.map_or("random".to_owned(), |layout| layout.to_string());
                let name = format!("{}, layout {words}, seed {seed}", task.id);
                let observation = world.reset(layout, seed)?;
                print(&name, &world, &observation, None)?;
                run(&name, &mut world, actions.as_deref())?;
            }
        }
    }
    Ok(())
}

fn run(name: &str, world: &mut World, actions: Option<&[Action]>) -> Result<()> {
    let mut actions = actions.map(<[Action]>::iter);
    loop {
        let action = match &mut actions {
            None => world.expert_action()?,
            Some(actions) => match actions.next() {
                Some(action) => *action,
                None => return Ok(()),
            },
        };
        let transition = world.step(&action)?;
        print(name, world, &transition.observation, Some(transition.statistics))?;
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
            anyhow!("expected {ACTION_LENGTH} numbers per line, got {}: {line:?}", numbers.len())
        })?;
        Ok(numbers.map(|number| number as f32))
    };
    text.lines().map(action).collect()
}

fn print(
    episode: &str,
    world: &World,
    seen: &Observation,
    statistics: Option<Statistics>,
) -> Result<()> {
    let (positions, velocities) = world.joints();
    let wide = |numbers: &[f64]| numbers.iter().map(|number| bits(number.to_bits(), 16)).collect();
    let narrow =
        |numbers: &[f32]| numbers.iter().map(|number| bits(number.to_bits().into(), 8)).collect();
    let digest = Sha256::digest(&seen.image.pixels);
    let line = Line {
        episode,
        step: world.steps()?,
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
