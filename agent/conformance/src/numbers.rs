//! Tests of request numbers (lost, repeated and reordered messages) and of bytes that do not encode
//! a request.

use anyhow::{Result, ensure};
use protocol::{Reply, Request, Transition, decode, encode, limits};

use super::subject::{SILENCE, Subject, Talk, names, unchecked};
use super::{Table, Tested};

pub async fn test(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row(
            "repeated",
            "a repeated request gets the same reply bytes and has no second effect",
            repeated(subject),
        )
        .await;
    table
        .row("older", "a request with a lower number than the last one is ignored", async {
            let mut talk = subject.episode(0).await?;
            let first = talk.request.clone();
            talk.hold_still().await?;
            talk.probe.send(&first).await?;
            silent(&mut talk).await?;
            talk.hold_still().await?;
            talk.close().await?;
            Ok(Tested::Kept)
        })
        .await;
    table
        .row(
            "gap",
            "a request that skips a number is refused, and its number is not used up",
            async {
                let mut talk = subject.episode(0).await?;
                let gap = talk.sequence + 2;
                let bytes = encode(&Request::Step { sequence: gap, action: subject.moving() })?;
                talk.refusal_of(&bytes, gap).await?;
                let expected = clean_step(subject, 0).await?;
                let got = talk.hold_still().await?;
                ensure!(got == expected, "expected the same step as in a session without the gap");
                talk.close().await?;
                Ok(Tested::Kept)
            },
        )
        .await;
    refusals(subject, table).await;
    wrong_actions(subject, table).await;
}

/// Tests of requests that leave the environment unchanged.
async fn refusals(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row("unreadable", "bytes that do not encode a request are refused with number 0", async {
            let mut talk = subject.episode(0).await?;
            let mut trailing = encode(&Request::Close { sequence: talk.sequence + 1 })?;
            trailing.push(0xc0);
            for bytes in [vec![], vec![0xc1], vec![0x80], b"step".to_vec(), trailing] {
                talk.refusal_of(&bytes, 0).await?;
            }
            unchanged(subject, talk).await
        })
        .await;
    table
        .row("size", "a request larger than 1 KiB is refused with number 0", async {
            let mut talk = subject.episode(0).await?;
            talk.refusal_of(&vec![0xc0; limits::REQUEST_BYTES_MAX + 1], 0).await?;
            unchanged(subject, talk).await
        })
        .await;
    table
        .row("number_limit", "a number of 2^53 or more is refused with number 0", async {
            let mut talk = subject.episode(0).await?;
            for sequence in [limits::SEED_END, u64::MAX] {
                talk.refusal_of(&unchecked(&Request::Close { sequence }), 0).await?;
            }
            unchanged(subject, talk).await
        })
        .await;
    table
        .row("slots", "a slot number above 15 is refused, and so is an empty slot", async {
            let mut talk = subject.episode(0).await?;
            let sequence = talk.sequence + 1;
            let bytes = unchecked(&Request::Save { sequence, slot: limits::SLOTS_MAX });
            names(&talk.refusal_of(&bytes, sequence).await?, &["slot"])?;
            talk.sequence = sequence;
            names(
                &talk.refused(|sequence| Request::Restore { sequence, slot: 3 }).await?,
                &["slot"],
            )?;
            unchanged(subject, talk).await
        })
        .await;
}

/// Tests of actions that are outside the described action space.
async fn wrong_actions(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row(
            "values",
            "an action with NaN or infinity is refused, and its number is used up",
            async {
                let mut talk = subject.episode(0).await?;
                for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    let mut action = subject.still();
                    let last = action.len() - 1;
                    action[last] = bad;
                    let words = ["action".to_owned(), format!("index {last}")];
                    wrong_action(&mut talk, action, &words).await?;
                }
                unchanged(subject, talk).await
            },
        )
        .await;
    table
        .row(
            "dimensions",
            "an action of the wrong length is refused, and its number is used up",
            async {
                let mut talk = subject.episode(0).await?;
                let described = subject.still().len();
                for length in [0, described - 1, described + 1, limits::ACTION_DIMENSIONS_MAX + 1] {
                    let words = ["action".to_owned(), length.to_string()];
                    wrong_action(&mut talk, vec![0.0; length], &words).await?;
                }
                unchanged(subject, talk).await
            },
        )
        .await;
    table
        .row(
            "discrete",
            "a discrete dimension that is not whole or out of bounds is refused, and the number is used up",
            discrete(subject),
        )
        .await;
}

/// Sends a step that must be refused with a reason that contains these words.
async fn wrong_action(talk: &mut Talk, action: Vec<f32>, words: &[String]) -> Result<()> {
    let sequence = talk.sequence + 1;
    let bytes = unchecked(&Request::Step { sequence, action });
    names(&talk.refusal_of(&bytes, sequence).await?, words)?;
    talk.sequence = sequence;
    Ok(())
}

async fn discrete(subject: &Subject<'_>) -> Result<Tested> {
    let dimensions = &subject.task().action;
    let Some(index) = dimensions.iter().position(|dimension| dimension.discrete) else {
        return Ok(Tested::NotTested("no dimension of the action is discrete".to_owned()));
    };
    let mut talk = subject.episode(0).await?;
    let (low, high) = (dimensions[index].low, dimensions[index].high);
    let (low, high) = (low.unwrap_or_default(), high.unwrap_or_default());
    for bad in [low + 0.5, high + 1.0, low - 1.0] {
        let mut action = subject.still();
        action[index] = bad;
        wrong_action(&mut talk, action, &["action".to_owned(), bad.to_string()]).await?;
    }
    unchanged(subject, talk).await
}

async fn repeated(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.episode(0).await?;
    let mut steps = Vec::new();
    for _ in 0..2 {
        steps.push(talk.go().await?);
        for _ in 0..2 {
            let again = talk.answer_to(&talk.request.clone()).await?;
            ensure!(
                again == talk.reply,
                "expected the same reply bytes, got {}",
                described(&again)
            );
        }
    }
    talk.close().await?;
    let mut clean = subject.episode(0).await?;
    let expected = [clean.go().await?, clean.go().await?];
    ensure!(steps == expected, "expected the same steps as in a session without repetitions");
    clean.close().await?;
    Ok(Tested::Kept)
}

/// A short description of a reply.
fn described(bytes: &[u8]) -> String {
    match decode(bytes) {
        Ok(Reply::Refused { sequence, reason }) => {
            format!("Refused with number {sequence}: {reason}")
        }
        Ok(Reply::Faulted { sequence, reason, .. }) => {
            format!("Faulted with number {sequence}: {reason}")
        }
        Ok(reply) => format!("other bytes, {} with number {}", reply.kind(), reply.sequence()),
        Err(error) => format!("bytes that do not encode a reply: {error}"),
    }
}

/// Checks that the refused request has changed nothing, and that the session continues.
async fn unchanged(subject: &Subject<'_>, mut talk: Talk) -> Result<Tested> {
    let (got, expected) = (talk.hold_still().await?, clean_step(subject, 0).await?);
    ensure!(got == expected, "expected the same step as in a session without the refusal");
    talk.close().await?;
    Ok(Tested::Kept)
}

/// The first step of an episode without invalid requests.
async fn clean_step(subject: &Subject<'_>, index: u64) -> Result<Transition> {
    let mut talk = subject.episode(index).await?;
    let transition = talk.hold_still().await?;
    talk.close().await?;
    Ok(transition)
}

async fn silent(talk: &mut Talk) -> Result<()> {
    let reply = talk.probe.receive(SILENCE).await;
    ensure!(reply.is_none(), "expected no reply, got {} bytes", reply.unwrap_or_default().len());
    Ok(())
}
