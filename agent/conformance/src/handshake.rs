//! Tests before any session: description, heartbeats, refused Open messages.

use std::time::Duration;

use anyhow::{Result, anyhow, ensure};
use protocol::{Open, Opening, PROTOCOL_VERSION, encode, limits};

use super::subject::{Subject, names, unchecked};
use super::{Table, Tested};
use runtime::wire::Probe;

/// Heartbeats come twice a second: four of them, of which one may be late.
const BEATS_WAIT: Duration = Duration::from_secs(2);
const BEATS_MIN: usize = 3;

pub async fn test(subject: &Subject<'_>, table: &mut Table<'_>) {
    greetings(subject, table).await;
    refusals(subject, table).await;
    table
        .row("sessions_max", "at most sessions_max sessions can be opened", sessions_max(subject))
        .await;
}

async fn greetings(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row(
            "describe",
            "a describe query is answered with a Description of this protocol version",
            async {
                let again = subject.network.describe(&subject.description.server).await?;
                ensure!(
                    again.tasks == subject.description.tasks,
                    "expected the same tasks in both descriptions"
                );
                Ok(Tested::Kept)
            },
        )
        .await;
    table
        .row("heartbeat", "heartbeats with the server's id are sent twice a second", beats(subject))
        .await;
    table
        .row(
            "version",
            "an Open of another protocol version is refused because of its version",
            async {
                let open = Open { protocol: PROTOCOL_VERSION + 1, ..subject.open() };
                let (expected, other) =
                    (format!("protocol {PROTOCOL_VERSION}"), (PROTOCOL_VERSION + 1).to_string());
                names(&refusal(subject, unchecked(&open)).await?, &[expected, other])?;
                Ok(Tested::Kept)
            },
        )
        .await;
}

async fn refusals(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row("open_task", "an Open of an unknown task is refused with its name", async {
            let open = Open { task: "no_such_task".to_owned(), ..subject.open() };
            names(&refusal(subject, encode(&open)?).await?, &["no_such_task"])?;
            Ok(Tested::Kept)
        })
        .await;
    table
        .row("open_image", "an Open with an image that is too large is refused", async {
            let open = Open { image_height: limits::IMAGE_SIDE_MAX as u32 + 1, ..subject.open() };
            names(&refusal(subject, unchecked(&open)).await?, &["image_height"])?;
            Ok(Tested::Kept)
        })
        .await;
    table
        .row("open_malformed", "bytes that do not encode an Open are refused", async {
            for bytes in [vec![], vec![0xc1], vec![0x80], b"open".to_vec()] {
                refusal(subject, bytes).await?;
            }
            let mut trailing = encode(&subject.open())?;
            trailing.push(0xc0);
            refusal(subject, trailing).await?;
            Ok(Tested::Kept)
        })
        .await;
    table
        .row("open_size", "an Open larger than 1 KiB is refused", async {
            refusal(subject, vec![0xc0; limits::OPEN_BYTES_MAX + 1]).await?;
            Ok(Tested::Kept)
        })
        .await;
}

async fn beats(subject: &Subject<'_>) -> Result<Tested> {
    let beats = subject.network.heartbeats(&subject.description.server, BEATS_WAIT).await?;
    let (count, seconds) = (beats.len(), BEATS_WAIT.as_secs());
    ensure!(
        count >= BEATS_MIN,
        "expected at least {BEATS_MIN} heartbeats in {seconds} s, got {count}"
    );
    let strangers = beats.iter().find(|beat| beat.server != subject.description.server);
    if let Some(beat) = strangers {
        return Err(anyhow!(
            "expected heartbeats of server {}, got one of {}",
            subject.description.server,
            beat.server
        ));
    }
    Ok(Tested::Kept)
}

async fn sessions_max(subject: &Subject<'_>) -> Result<Tested> {
    const OPENED_MAX: u32 = 16;
    let now = subject.network.describe(&subject.description.server).await?;
    let free = now.sessions_max.saturating_sub(now.sessions);
    if free > OPENED_MAX {
        return Ok(Tested::NotTested(format!(
            "the server has {free} free sessions; at most {OPENED_MAX} are opened"
        )));
    }
    let mut held = Vec::new();
    for _ in 0..free {
        held.push(subject.talk().await?);
    }
    let full = subject.network.describe(&subject.description.server).await?;
    ensure!(
        full.sessions == full.sessions_max,
        "expected {} sessions in the description, got {}",
        full.sessions_max,
        full.sessions
    );
    refusal(subject, encode(&subject.open())?).await?;
    for talk in &mut held {
        talk.close().await?;
    }
    // A closed session is no longer in use.
    subject.talk().await?.close().await?;
    Ok(Tested::Kept)
}

/// The reason why these bytes are refused.
async fn refusal(subject: &Subject<'_>, payload: Vec<u8>) -> Result<String> {
    match Probe::ask_to_open(subject.network, &subject.description.server, payload).await? {
        Opening::Refused { reason } => Ok(reason),
        Opening::Opened { .. } => Err(anyhow!("expected Refused, got Opened")),
    }
}
