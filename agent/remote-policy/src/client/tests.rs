//! Clients against scripted servers on real sockets.

mod act;
mod faults;
mod hostile;
mod openpi;
mod scripted;
mod vla_eval;

use decision::{EpisodeName, EpisodeToken, Image, Policy, Proposal, ProposalRequest};

use super::{ClientOptions, RemotePolicy};

/// An image of the size of the profile `bridge`.
pub fn image() -> Image {
    Image { height: 224, width: 224, pixels: vec![7; 224 * 224 * 3].into() }
}

/// A Bridge state.
pub const STATE: [f32; 8] = [0.25, 0.5, 0.75, 0.0, 0.0, 0.0, 0.0, 1.0];

/// A policy at this address, with a profile.
pub fn connect(address: &str, profile: Option<&str>) -> anyhow::Result<RemotePolicy> {
    let options = ClientOptions { profile: profile.map(str::to_owned), key: None };
    RemotePolicy::connect(address.parse()?, options)
}

/// A new episode.
pub fn episode() -> EpisodeToken {
    EpisodeToken::new(EpisodeName { task: "widowx_stack_cube".to_owned(), episode: 3 })
}

/// One decision of an episode.
pub fn propose(
    policy: &RemotePolicy,
    episode: &EpisodeToken,
    candidates: usize,
    seed: u64,
) -> anyhow::Result<Proposal> {
    propose_seeing(&image(), policy, episode, (candidates, seed))
}

/// The same for another image.
pub fn propose_seeing(
    image: &Image,
    policy: &RemotePolicy,
    episode: &EpisodeToken,
    (candidates, seed): (usize, u64),
) -> anyhow::Result<Proposal> {
    let request = ProposalRequest {
        image,
        state: &STATE,
        instruction: "stack the cubes",
        candidates,
        temperature: 1.0,
        seed,
        episode: Some(episode),
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    Ok(runtime.block_on(policy.propose(&[request]))?.remove(0))
}

/// The x motions of all candidates in their first step.
pub fn motions(proposal: &Proposal) -> Vec<f32> {
    let actions = proposal.candidates.iter().map(|one| one.action().expect("well formed").actions);
    actions.map(|actions| actions.first()[0]).collect()
}

/// The words of a refusal.
pub fn words<T>(result: anyhow::Result<T>) -> String {
    match result {
        Ok(_) => panic!("expected a refusal"),
        Err(error) => format!("{error:#}"),
    }
}
