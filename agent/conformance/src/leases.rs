//! Tests of leases: how sessions end.

use std::time::Duration;

use anyhow::{Result, bail, ensure};
use protocol::{Reply, Request, decode};

use super::subject::Subject;
use super::{Table, Tested};
use runtime::wire::Probe;

/// How long a session lives without its holder.
const HOLDER_WAIT: Duration = Duration::from_secs(10);
/// Margin for servers that check their leases periodically.
const LATE_MAX: Duration = Duration::from_secs(3);

pub async fn test(subject: &Subject<'_>, table: &mut Table<'_>) {
    table
        .row(
            "close",
            "a repeated Close is answered again, because its reply may be lost; later requests are refused",
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
                    "expected the session to be free again"
                );
                Ok(Tested::Kept)
            },
        )
        .await;
    table
        .row("holder_missing", "a session without a holder's token within 10 s ends", async {
            let server = &subject.description.server;
            let mut probe = Probe::open(subject.network, server, &subject.open()).await?;
            ended(&mut probe, HOLDER_WAIT + LATE_MAX).await?;
            Ok(Tested::Kept)
        })
        .await;
}

/// Waits for the server's message that the session has ended.
async fn ended(probe: &mut Probe, wait: Duration) -> Result<()> {
    match probe.receive(wait).await {
        None => bail!("expected Refused with number 0 within {wait:?}, got no reply"),
        Some(bytes) => match decode(&bytes)? {
            Reply::Refused { sequence: 0, .. } => Ok(()),
            other => {
                bail!(
                    "expected Refused with number 0, got {} with number {}",
                    other.kind(),
                    other.sequence()
                )
            }
        },
    }
}

async fn sessions(subject: &Subject<'_>) -> Result<u32> {
    Ok(subject.network.describe(&subject.description.server).await?.sessions)
}
