//! Leases: how sessions end.

use std::time::Duration;

use anyhow::{Result, bail, ensure};
use protocol::{Reply, Request, decode};

use super::subject::Subject;
use super::{Table, Tested};
use runtime::wire::Probe;

/// A session without its holder lives this long.
const HOLDER_WAIT: Duration = Duration::from_secs(10);
/// Servers look at their leases now and then.
const LATE_MAX: Duration = Duration::from_secs(3);

pub async fn test(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row(
            "close",
            "Close is answered again for its last reply may be lost; nothing follows it",
            async {
                let mut talk = subject.episode(0).await?;
                talk.close().await?;
                let again = talk.answer_to(&talk.request.clone()).await?;
                ensure!(again == talk.reply, "expected the same bytes for the same Close");
                talk.refused(|sequence| Request::Step { sequence, action: subject.still() })
                    .await?;
                Ok(Tested::Kept)
            },
        )
        .await;
    table
        .row(
            "holder_gone",
            "a session ends when its holder's token has been gone for 10 s",
            async {
                let before = sessions(subject).await?;
                let mut talk = subject.episode(0).await?;
                talk.probe.let_go().await?;
                ended(&mut talk.probe, HOLDER_WAIT + LATE_MAX).await?;
                ensure!(
                    sessions(subject).await? <= before,
                    "expected its session to be free again"
                );
                Ok(Tested::Kept)
            },
        )
        .await;
    table
        .row("holder_missing", "a session that nobody holds within 10 s ends", async {
            let server = &subject.description.server;
            let mut probe = Probe::open(subject.network, server, &subject.open()).await?;
            ended(&mut probe, HOLDER_WAIT + LATE_MAX).await?;
            Ok(Tested::Kept)
        })
        .await;
}

/// Waits until the server says that the session has ended.
async fn ended(probe: &mut Probe, wait: Duration) -> Result<()> {
    match probe.receive(wait).await {
        None => bail!("expected Refused number 0 within {wait:?}, got nothing"),
        Some(bytes) => match decode(&bytes)? {
            Reply::Refused { sequence: 0, .. } => Ok(()),
            other => {
                bail!("expected Refused number 0, got {} number {}", other.kind(), other.sequence())
            }
        },
    }
}

async fn sessions(subject: &Subject<'_>) -> Result<u32> {
    Ok(subject.network.describe(&subject.description.server).await?.sessions)
}
