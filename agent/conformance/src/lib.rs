//! Tests any server against the protocol's specification, over the wire, as an agent in another language would meet it.
//!
//! Rows are independent: each opens sessions of its own, and a server that fails one goes on to the next.

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

/// A server that an endpoint leads to is seen within this time.
const SERVER_WAIT: Duration = Duration::from_secs(30);

/// One rule of the specification and whether the server keeps it.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Short, for scripts.
    pub name: &'static str,
    /// What the specification says.
    pub rule: &'static str,
    /// What came of it.
    pub verdict: Verdict,
    /// What was expected and what came, or why it was not tested.
    pub reason: Option<String>,
}

/// What came of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// The rule is kept.
    Pass,
    /// It is not.
    Fail,
    /// It could not be tested on this server.
    Skip,
}

/// What a single test came to, when it did not break.
enum Tested {
    Kept,
    NotTested(String),
}

/// All rows, and whoever wants to see them as they come.
struct Table<'a> {
    subject: &'a Subject<'a>,
    rows: Vec<Row>,
    report: &'a mut dyn FnMut(&Row),
}

impl Table<'_> {
    /// Tests one rule; an error is its failure.
    async fn row(
        &mut self,
        name: &'static str,
        rule: &'static str,
        test: impl Future<Output = Result<Tested>>,
    ) {
        let result = test.await;
        // What the test left open must not fail the next one.
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

/// Tests `server`, or the first one that is seen. `report` gets each row when it is done.
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
            found.undescribed.iter().map(|(id, reason)| format!("; server {id} {reason}"));
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
