//! Numbered requests on a wire that may lose, double and reorder them, and bytes that are no requests.

use anyhow::{Result, ensure};
use protocol::{Reply, Request, decode, encode, limits};

use super::subject::{HOLD_STILL, MOVE, SILENCE, Subject, Talk, names, unchecked};
use super::{Table, Tested};

pub async fn test(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row(
            "repeated",
            "the last request again: the same bytes again, nothing is done twice",
            repeated(subject),
        )
        .await;
    table
        .row("older", "a request with a lower number than the last is dropped", async {
            let mut talk = subject.episode(0).await?;
            let first = talk.request.clone();
            talk.step(HOLD_STILL).await?;
            talk.probe.send(&first).await?;
            silent(&mut talk).await?;
            talk.step(HOLD_STILL).await?;
            talk.close().await?;
            Ok(Tested::Kept)
        })
        .await;
    table
        .row("gap", "a number too many is refused and not used up", async {
            let mut talk = subject.episode(0).await?;
            let gap = talk.sequence + 2;
            let bytes = encode(&Request::Step { sequence: gap, action: MOVE })?;
            talk.refusal_of(&bytes, gap).await?;
            let expected = clean_step(subject, 0).await?;
            talk.step(HOLD_STILL).await?;
            ensure!(talk.reply == expected, "expected the reply of a session without the gap");
            talk.close().await?;
            Ok(Tested::Kept)
        })
        .await;
    refusals(subject, table).await;
}

/// What leaves the world as it was.
async fn refusals(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row("unreadable", "bytes that are no request are refused with number 0", async {
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
        .row("size", "a request beyond 1 KiB is refused with number 0", async {
            let mut talk = subject.episode(0).await?;
            talk.refusal_of(&vec![0xc0; limits::REQUEST_BYTES_MAX + 1], 0).await?;
            unchanged(subject, talk).await
        })
        .await;
    table
        .row("number_limit", "a number beyond 2^53 is refused with number 0", async {
            let mut talk = subject.episode(0).await?;
            for sequence in [limits::SEED_END, u64::MAX] {
                talk.refusal_of(&unchecked(&Request::Close { sequence }), 0).await?;
            }
            unchanged(subject, talk).await
        })
        .await;
    table
        .row("values", "an action with NaN or infinity is refused; its number is used up", async {
            let mut talk = subject.episode(0).await?;
            for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                let mut action = HOLD_STILL;
                action[3] = bad;
                let sequence = talk.sequence + 1;
                let bytes = unchecked(&Request::Step { sequence, action });
                names(&talk.refusal_of(&bytes, sequence).await?, &["action", "index 3"])?;
                talk.sequence = sequence;
            }
            unchanged(subject, talk).await
        })
        .await;
    table
        .row("slots", "a slot from 16 on is refused, and so is an empty one", async {
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

async fn repeated(subject: &Subject<'_>) -> Result<Tested> {
    let mut talk = subject.episode(0).await?;
    for _ in 0..2 {
        talk.step(MOVE).await?;
        for _ in 0..2 {
            let again = talk.answer_to(&talk.request.clone()).await?;
            ensure!(again == talk.reply, "expected the same bytes again, got others");
        }
    }
    let twice = talk.reply.clone();
    talk.close().await?;
    let mut clean = subject.episode(0).await?;
    clean.step(MOVE).await?;
    clean.step(MOVE).await?;
    ensure!(clean.reply == twice, "expected what a session without repetitions gives");
    clean.close().await?;
    Ok(Tested::Kept)
}

/// What was refused has left the world as it was, and the session goes on.
async fn unchanged(subject: &Subject<'_>, mut talk: Talk) -> Result<Tested> {
    talk.step(HOLD_STILL).await?;
    let (Reply::Stepped { transition: got, .. }, Reply::Stepped { transition: expected, .. }) =
        (decode(&talk.reply)?, decode(&clean_step(subject, 0).await?)?)
    else {
        unreachable!("both were steps");
    };
    ensure!(got == expected, "expected the step of a session without the refusal");
    talk.close().await?;
    Ok(Tested::Kept)
}

/// The reply to the first step of an undisturbed episode.
async fn clean_step(subject: &Subject<'_>, index: u64) -> Result<Vec<u8>> {
    let mut talk = subject.episode(index).await?;
    talk.step(HOLD_STILL).await?;
    let reply = talk.reply.clone();
    talk.close().await?;
    Ok(reply)
}

async fn silent(talk: &mut Talk) -> Result<()> {
    let reply = talk.probe.receive(SILENCE).await;
    ensure!(reply.is_none(), "expected silence, got {} bytes", reply.unwrap_or_default().len());
    Ok(())
}
