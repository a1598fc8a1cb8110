//! Tests any server against the protocol specification over the network, without assumptions about
//! its implementation.
//!
//! The rules are tested independently: each test opens its own sessions, and a failure does not
//! stop the following tests.

mod episodes;
mod handshake;
mod leases;
mod numbers;
mod subject;

use std::time::Duration;

use anyhow::{Context, Result};
use serde::Serialize;

use self::subject::Subject;
use runtime::wire::Network;

/// Discovery timeout of the server.
const SERVER_WAIT: Duration = Duration::from_secs(30);

/// One rule of the specification and the result of its test.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// A short name for scripts.
    pub name: &'static str,
    /// The rule of the specification.
    pub rule: &'static str,
    /// The result of the test.
    pub verdict: Verdict,
    /// What was expected and what was received, or why the rule was not tested.
    pub reason: Option<String>,
}

/// The result of a test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// The server follows the rule.
    Pass,
    /// The server violates the rule.
    Fail,
    /// The rule cannot be tested on this server.
    Skip,
}

/// The result of a test that did not fail.
enum Tested {
    Kept,
    NotTested(String),
}

/// All results, and a callback that receives each result at once.
struct Table<'a> {
    subject: &'a Subject<'a>,
    rows: Vec<Row>,
    report: &'a mut dyn FnMut(&Row),
}

impl Table<'_> {
    /// Tests one rule; an error means that the server violates it.
    async fn row(
        &mut self,
        name: &'static str,
        rule: &'static str,
        test: impl Future<Output = Result<Tested>>,
    ) {
        let result = test.await;
        // Sessions left open by this test must not affect the next one.
        self.subject.settle().await;
        let (verdict, reason) = match result {
            Ok(Tested::Kept) => (Verdict::Pass, None),
            Ok(Tested::NotTested(reason)) => (Verdict::Skip, Some(reason)),
            Err(error) => (Verdict::Fail, Some(format!("{error:#}"))),
        };
        let row = Row { name, rule, verdict, reason };
        (self.report)(&row);
        self.rows.push(row);
    }
}

/// Tests `server`, or the first server found. `report` receives each result as soon as it is known.
pub async fn test(
    network: &Network,
    server: Option<&str>,
    report: &mut dyn FnMut(&Row),
) -> Result<Vec<Row>> {
    let found = network.servers(1, SERVER_WAIT).await;
    let wanted = |seen: &str| server.is_none_or(|server| server == seen);
    let mut descriptions = found.servers.into_values();
    let description = descriptions.find(|description| wanted(&description.server));
    let description = description.with_context(|| {
        let reasons =
            found.undescribed.iter().map(|(id, reason)| format!("; server {id}: {reason}"));
        let reasons: String = reasons.collect();
        format!("no environment server found: check --connect and --fleet{reasons}")
    })?;
    let subject = Subject::new(network, description)?;
    let mut table = Table { subject: &subject, rows: Vec::new(), report };
    handshake::test(&subject, &mut table).await;
    numbers::test(&subject, &mut table).await;
    episodes::test(&subject, &mut table).await;
    leases::test(&subject, &mut table).await;
    Ok(table.rows)
}
