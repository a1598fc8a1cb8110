//! What reads the candidates in the records of a run: the checkpoint that proposed them, or the records alone if it was
//! a policy server.

use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use decision::{ActionSpace, Malformed};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use store::run::RunHeader;
use verifier::training::records::CompletionReader;
use vla::CompletionParser;

use super::WrongUsage;
use super::episodes::POLICY_SERVER;

/// The policy of the records.
pub enum RecordedPolicy {
    /// A checkpoint, whose tokenizer decodes the recorded tokens.
    Checkpoint(Arc<CompletionParser>),
    /// A policy server. The records hold what it said, or what the backbone read.
    Server {
        /// Identity of the policy.
        digest: String,
        /// Length of a candidate's hidden state.
        hidden_size: usize,
        /// How to compare its actions.
        action_space: ActionSpace,
    },
}

/// What the candidates of a run with a policy server are read with: `served` of its header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServedPolicy {
    /// Length of a candidate's hidden state; `None` if the server exposes none and no backbone read the candidates.
    pub hidden_size: Option<usize>,
    /// How to compare its actions.
    pub action_space: ActionSpace,
    /// The checkpoint that read the candidates, as it was named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub backbone: Option<String>,
}

impl RecordedPolicy {
    /// The policy server of runs; `None` if no run has one. All runs must have the same policy and profile.
    pub fn server_of(headers: &[RunHeader]) -> Result<Option<RecordedPolicy>> {
        let is_served = |header: &&RunHeader| header.options.get(POLICY_SERVER).is_some();
        let Some(first) = headers.iter().find(is_served) else { return Ok(None) };
        let digest = policy_digest(first)?;
        for header in headers {
            let got = policy_digest(header)?;
            ensure!(
                got == digest
                    && header.options.get(POLICY_SERVER) == first.options.get(POLICY_SERVER),
                WrongUsage(format!(
                    "runs: expected runs of one policy server with one profile, got those of policy {digest} and of \
                     policy {got}, or of another profile or a local policy"
                ))
            );
        }
        let served = first.served.as_ref().context(WrongUsage(
            "this run with a policy server was recorded by an older version, without what its candidates are read with; \
             collect its episodes again"
                .to_owned(),
        ))?;
        let served = ServedPolicy::deserialize(served).context("run.json: served")?;
        let hidden_size = served.hidden_size.filter(|size| *size > 0).with_context(|| {
            WrongUsage(
                "the policy server of this run exposes no hidden states, which a verifier reads; collect episodes with \
                 --backbone included, so that a checkpoint reads its candidates"
                    .to_owned(),
            )
        })?;
        let action_space = served.action_space;
        Ok(Some(RecordedPolicy::Server { digest: digest.to_owned(), hidden_size, action_space }))
    }

    /// Identity of the policy, in hexadecimal.
    pub fn digest(&self) -> &str {
        match self {
            RecordedPolicy::Checkpoint(parser) => parser.digest(),
            RecordedPolicy::Server { digest, .. } => digest,
        }
    }

    /// Length of a candidate's hidden state.
    pub fn hidden_size(&self) -> usize {
        match self {
            RecordedPolicy::Checkpoint(parser) => parser.hidden_size(),
            RecordedPolicy::Server { hidden_size, .. } => *hidden_size,
        }
    }

    /// How to compare its actions.
    pub fn action_space(&self) -> ActionSpace {
        match self {
            RecordedPolicy::Checkpoint(parser) => parser.action_space(),
            RecordedPolicy::Server { action_space, .. } => action_space.clone(),
        }
    }

    /// Calls `read` with what decodes the candidates.
    pub fn with_reader<T>(&self, read: impl FnOnce(CompletionReader<'_>) -> T) -> T {
        let (policy, action_space) = (self.digest(), &self.action_space());
        match self {
            RecordedPolicy::Checkpoint(parser) => read(CompletionReader {
                policy,
                action_space,
                parse: &|tokens| parser.parse(tokens),
                confidence: &|tokens, log_probabilities| {
                    parser.confidence(tokens, log_probabilities)
                },
            }),
            RecordedPolicy::Server { .. } => read(CompletionReader {
                policy,
                action_space,
                parse: &|_| Err(Malformed::new("expected a record of what the policy server said")),
                confidence: &|_, _| Vec::new(),
            }),
        }
    }
}

/// The policy options of a run with a policy server, with a space before each. Its address is not part of the run.
pub fn served_words(header: &RunHeader) -> String {
    let server = &header.options[POLICY_SERVER];
    let word = |name: &str| server[name].as_str();
    let backbone = header.served.as_ref().and_then(|served| served["backbone"].as_str());
    let mut words = format!(" --policy {}://HOST:PORT", word("wire").unwrap_or("openpi"));
    if let Some(profile) = word("profile") {
        words += &format!(" --policy-profile {profile}");
    }
    if let Some(backbone) = backbone {
        words += &format!(" --backbone {backbone}");
    }
    words
}

fn policy_digest(header: &RunHeader) -> Result<&str> {
    let digest = header.versions.get("policy").and_then(Value::as_str);
    digest.context("run.json: expected the digest of a policy, got none")
}
