//! Tests of episodes: order of requests, determinism, save and restore, the horizon.

use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use protocol::{Observation, Open, Reply, Request, TaskDescription, Transition, decode};

use super::subject::{Subject, Talk, names};
use super::{Table, Tested};

/// Number of steps that are compared.
const STEPS: usize = 6;

pub async fn test(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row("reset_first", "Step, Save and Restore before the first Reset are refused", async {
            let mut talk = subject.talk().await?;
            talk.refused(|sequence| Request::Step { sequence, action: subject.still() }).await?;
            talk.refused(|sequence| Request::Save { sequence, slot: 0 }).await?;
            talk.refused(|sequence| Request::Restore { sequence, slot: 0 }).await?;
            talk.reset(0).await?;
            talk.close().await?;
            Ok(Tested::Kept)
        })
        .await;
    table
        .row(
            "observation",
            "an observation has the requested image, the described state and no expert action",
            observation(subject),
        )
        .await;
    table
        .row(
            "reset_task",
            "a Reset to an unknown task, variant or layout is refused",
            reset_task(subject),
        )
        .await;
    table
        .row(
            "tasks",
            "every task in every variant can be reset and has the described instruction and state",
            tasks(subject),
        )
        .await;
    table
        .row(
            "deterministic",
            "the same Reset and actions give the same transitions, in any session",
            deterministic(subject),
        )
        .await;
    table
        .row(
            "simulator_time",
            "simulator_us of a step is positive and at most its round-trip time",
            simulator_time(subject),
        )
        .await;
    table.row("seeds", "different seeds give different layouts", seeds(subject)).await;
    table
        .row("save", "Save and Restore are bit-exact; Reset empties the slots", save(subject))
        .await;
    table
        .row("concurrent", "concurrent sessions do not affect each other", concurrent(subject))
        .await;
    table
        .row(
            "horizon",
            "the last step is truncated, and a further step is refused",
            horizon(subject),
        )
        .await;
}

async fn seeds(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.talk().await?;
    let first = talk.reset(0).await?;
    let second = talk.reset(1).await?;
    talk.close().await?;
    ensure!(first != second, "expected different observations with different seeds");
    Ok(Tested::Kept)
}

async fn observation(subject: &Subject<'_>) -> Result<Tested> {
    let (height, width) = (subject.side(24), subject.side(40));
    let open = Open { image_height: height, image_width: width, ..subject.open() };
    let mut talk = subject.talk_with(&open).await?;
    let seen = talk.reset(0).await?;
    let (rows, columns) = (seen.image.height, seen.image.width);
    ensure!(
        (rows, columns) == (height as usize, width as usize),
        "expected an image of {height} x {width}, got {rows} x {columns}"
    );
    as_described(subject.task(), &seen)?;
    ensure!(seen.expert_action.is_none(), "expected no expert action, got one");
    talk.close().await?;
    Ok(Tested::Kept)
}

async fn tasks(subject: &Subject<'_>) -> Result<Tested> {
    // Without images, because some servers need a long time to set up rendering.
    let open = Open { image_height: 0, image_width: 0, ..subject.open() };
    let mut talk = subject.talk_with(&open).await?;
    for task in &subject.description.tasks {
        talk.task = task.clone();
        let seen = talk.reset(0).await;
        seen.and_then(|seen| as_described(task, &seen))
            .with_context(|| format!("task {}, variant {}", task.task, task.variant))?;
    }
    talk.close().await?;
    Ok(Tested::Kept)
}

fn as_described(task: &TaskDescription, seen: &Observation) -> Result<()> {
    ensure!(
        seen.state.len() == task.state.len(),
        "expected a state with {} dimensions, as in the description, got {}",
        task.state.len(),
        seen.state.len()
    );
    ensure!(
        seen.instruction == task.instruction || task.instruction.is_empty(),
        "expected the instruction {:?}, got {:?}",
        task.instruction,
        seen.instruction
    );
    Ok(())
}

async fn reset_task(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.episode(0).await?;
    let own = subject.task();
    let (strange_task, strange_variant) = ("no_such_task", "no_such_variant");
    for (task, variant, strange) in [
        (strange_task, &*own.variant, strange_task),
        (&*own.task, strange_variant, strange_variant),
    ] {
        let (task, variant) = (task.to_owned(), variant.to_owned());
        let reset = |sequence| Request::Reset { sequence, task, variant, layout: None, seed: 0 };
        names(&talk.refused(reset).await?, &[strange])?;
    }
    let beyond = own.layouts;
    let request = talk.resetting(Some(beyond), 0);
    names(&talk.refused(request).await?, &["layout", &beyond.to_string()])?;
    // After a refusal the environment is unchanged and the episode continues.
    talk.hold_still().await?;
    talk.save(0).await?;
    // Both steps follow a Restore, because its exactness is tested by another rule.
    talk.restore(0).await?;
    let expected = stepped(talk.go().await?);
    talk.restore(0).await?;
    let offered = &subject.description.tasks;
    let other_task = offered.iter().find(|other| other.task != own.task);
    let mut variants = offered.iter().filter(|other| other.task == own.task);
    let other_variant = variants.find(|other| other.variant != own.variant);
    for other in other_task.into_iter().chain(other_variant) {
        let TaskDescription { task, variant, layouts, .. } = other.clone();
        let layout = Some(layouts);
        let reset = |sequence| Request::Reset { sequence, task, variant, layout, seed: 0 };
        names(&talk.refused(reset).await?, &["layout"])?;
        equal(std::slice::from_ref(&expected), &[stepped(talk.go().await?)])?;
        talk.restore(0).await?;
    }
    talk.close().await?;
    Ok(Tested::Kept)
}

/// The replies to a Reset and some steps, all with number 1.
async fn trajectory(talk: &mut Talk, index: u64) -> Result<Vec<Reply>> {
    let mut replies = vec![Reply::Observed { sequence: 1, observation: talk.reset(index).await? }];
    for _ in 0..STEPS {
        replies.push(stepped(talk.go().await?));
    }
    Ok(replies)
}

/// Encoding and duration of a step do not matter for the comparison.
fn stepped(transition: Transition) -> Reply {
    Reply::Stepped { sequence: 1, transition, changed_tiles: None, simulator_us: 0 }
}

fn equal(expected: &[Reply], got: &[Reply]) -> Result<()> {
    let differs = expected.iter().zip(got).position(|(expected, got)| expected != got);
    if let Some(step) = differs {
        let what = difference(&expected[step], &got[step]);
        bail!("expected equal replies, got a different {what} at step {step}");
    }
    Ok(())
}

/// The first part in which two replies to the same request differ.
fn difference(expected: &Reply, got: &Reply) -> &'static str {
    let parts = |reply: &Reply| match reply {
        Reply::Observed { observation, .. } => Some((observation.clone(), None)),
        Reply::Stepped { transition, .. } => {
            let rest = (transition.statistics, transition.reward, transition.truncated);
            Some((transition.observation.clone(), Some(rest)))
        }
        _ => None,
    };
    match (parts(expected), parts(got)) {
        (Some((expected, before)), Some((got, after))) => match () {
            () if expected.state != got.state => "state",
            () if expected.image != got.image => "image",
            () if before != after => "outcome",
            () => "observation",
        },
        _ => "kind of reply",
    }
}

async fn deterministic(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.talk().await?;
    let first = trajectory(&mut talk, 0).await?;
    trajectory(&mut talk, 1).await?;
    let again = trajectory(&mut talk, 0).await?;
    talk.close().await?;
    equal(&first, &again)?;
    let mut other = subject.talk().await?;
    let elsewhere = trajectory(&mut other, 0).await?;
    other.close().await?;
    equal(&first, &elsewhere)?;
    Ok(Tested::Kept)
}

async fn simulator_time(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.episode(0).await?;
    let mut said_us = 0;
    for _ in 0..STEPS {
        let asked_at = Instant::now();
        talk.go().await?;
        let round_trip_us = asked_at.elapsed().as_micros();
        let Reply::Stepped { simulator_us, .. } = decode(&talk.reply)? else {
            unreachable!("it was a step");
        };
        ensure!(
            u128::from(simulator_us) <= round_trip_us,
            "expected simulator_us of at most the round-trip time {round_trip_us}, got {simulator_us}"
        );
        said_us += u64::from(simulator_us);
    }
    talk.close().await?;
    ensure!(
        said_us > 0,
        "expected simulator_us above 0 in at least one of {STEPS} steps, got 0 in all"
    );
    Ok(Tested::Kept)
}

async fn save(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.episode(0).await?;
    let saved = talk.go().await?;
    talk.save(2).await?;
    let mut first = Vec::new();
    for _ in 0..STEPS {
        first.push(stepped(talk.go().await?));
    }
    let restored = talk.restore(2).await?;
    ensure!(restored == saved.observation, "expected the saved observation, got a different one");
    let mut again = Vec::new();
    for _ in 0..STEPS {
        again.push(stepped(talk.go().await?));
    }
    equal(&first, &again)?;
    talk.reset(0).await?;
    talk.refused(|sequence| Request::Restore { sequence, slot: 2 }).await?;
    talk.close().await?;
    Ok(Tested::Kept)
}

async fn concurrent(subject: &Subject<'_>) -> Result<Tested> {
    let now = subject.network.describe(&subject.description.server).await?;
    if now.sessions_max - now.sessions < 2 {
        return Ok(Tested::NotTested("the server has fewer than two free sessions".to_owned()));
    }
    let mut alone = subject.talk().await?;
    let expected = [trajectory(&mut alone, 0).await?, trajectory(&mut alone, 1).await?];
    alone.close().await?;
    let (mut one, mut other) = (subject.talk().await?, subject.talk().await?);
    let (first, second) = tokio::join!(trajectory(&mut one, 0), trajectory(&mut other, 1));
    equal(&expected[0], &first?)?;
    equal(&expected[1], &second?)?;
    one.close().await?;
    other.close().await?;
    Ok(Tested::Kept)
}

async fn horizon(subject: &Subject<'_>) -> Result<Tested> {
    const STEPS_MAX: u32 = 1_000;
    let steps_max = subject.task().steps_max;
    if steps_max > STEPS_MAX {
        return Ok(Tested::NotTested(format!("the horizon of {steps_max} steps is too long")));
    }
    let mut talk = subject.episode(0).await?;
    for step in 1..=steps_max {
        let transition = talk.hold_still().await?;
        ensure!(
            transition.truncated == (step == steps_max) || transition.terminated,
            "expected truncated only at step {steps_max}, got {} at step {step}",
            transition.truncated
        );
        if transition.terminated {
            break;
        }
    }
    talk.refused(|sequence| Request::Step { sequence, action: subject.still() }).await?;
    talk.reset(0).await?;
    talk.close().await?;
    Ok(Tested::Kept)
}
