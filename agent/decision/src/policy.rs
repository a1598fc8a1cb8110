//! The interface of policies: a local checkpoint, a policy server, a script.

use anyhow::Result;
use async_trait::async_trait;

use crate::{ActionSpace, Candidate, Proposal, ProposalRequest, Setting};

/// What other components need to know about a policy.
#[derive(Debug, Clone, PartialEq)]
pub struct PolicyInfo {
    /// Identity of the computation, in hexadecimal: policies with the same digest give the same
    /// candidates.
    pub digest: String,
    /// Height and width of the images that the policy expects.
    pub image_size: (usize, usize),
    /// The policy's action space.
    pub action_space: ActionSpace,
    /// Length of a candidate's hidden state; `None` if the policy does not expose it.
    pub hidden_size: Option<usize>,
    /// How many calls of [`Policy::propose`] are computed in parallel; 1 if a large batch takes
    /// hardly longer than a small one.
    pub parallel_calls: usize,
}

/// Proposes candidates. The proposal for a request must not depend on the other requests of the
/// batch.
#[async_trait]
pub trait Policy: Send + Sync {
    /// Information about this policy.
    fn info(&self) -> &PolicyInfo;

    /// Samples candidates for all requests; returns one proposal per request, in the same order.
    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>>;

    /// Refuses a setting that this policy cannot do, and says why. What samples candidates checks its
    /// settings with this before the first request.
    fn check(&self, _setting: &Setting) -> Result<()> {
        Ok(())
    }

    /// The text of a candidate, if the policy writes one.
    fn text(&self, _candidate: &Candidate) -> Option<String> {
        None
    }
}
