//! The seam for policies: a local checkpoint, a policy server, a script.

use anyhow::Result;
use async_trait::async_trait;

use crate::{ActionSpace, Proposal, ProposalRequest};

/// What others need to know of a policy.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyInfo {
    /// What it computes, in hexadecimal: policies with one digest give the same candidates.
    pub digest: String,
    /// Height and width of the images that it wants.
    pub image_size: (usize, usize),
    /// The numbers of its actions.
    pub action_space: ActionSpace,
    /// Length of a candidate's hidden state; none where the policy tells none.
    pub hidden_size: Option<usize>,
    /// Calls of [`Policy::propose`] that it computes side by side; 1 where a larger batch costs hardly more than a small one.
    pub parallel_calls: usize,
}

/// Proposes candidates. What a request gets must not depend on the requests beside it.
#[async_trait]
pub trait Policy: Send + Sync {
    /// Of this policy.
    fn info(&self) -> &PolicyInfo;

    /// Samples the candidates of every request, one proposal for each, in their order.
    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>>;
}
