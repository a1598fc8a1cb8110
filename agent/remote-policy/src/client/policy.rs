//! A policy server as a `decision::Policy`.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use async_trait::async_trait;
use decision::{Policy, PolicyInfo, Proposal, ProposalRequest, Setting, Strategy};
use sha2::{Digest, Sha256};
use tokio::runtime::{Builder, Runtime};
use tokio::time::interval;

use super::candidates::{are_identical, of_actions, of_answer};
use super::connection::{Connection, Greeting, Question, Target};
use super::episodes::{Episodes, connections_wanted};
use crate::codec::extension::{Announcement, Ask};
use crate::profile::Answers;
use crate::{Address, Profile, Wire};

/// Threads that read and write sockets.
const THREADS: usize = 2;
/// Time between two looks for episodes that are over.
const END_INTERVAL: Duration = Duration::from_millis(500);
/// Consecutive decisions with identical candidates before a warning is logged.
const IDENTICAL_DECISIONS: u32 = 3;
/// Batches that may be asked at the same time: one per episode of a large run.
const PARALLEL_CALLS: usize = 64;
/// The profile of a server that announces the optional fields, unless another one is asked for.
const PROFILE_ANNOUNCED: &str = "rever";

/// How a policy server is used.
#[derive(Debug, Clone, Default)]
pub struct ClientOptions {
    /// Name or file of the profile; by default that of the server's kind.
    pub profile: Option<String>,
    /// Sent as `Authorization: Api-Key`.
    pub key: Option<String>,
}

/// A policy server.
pub struct RemotePolicy {
    shared: Arc<Shared>,
    info: PolicyInfo,
    profile_name: String,
    /// Runs the connections, whatever runtime a caller has. Taken when dropped.
    runtime: Option<Runtime>,
}

struct Shared {
    target: Target,
    greeting: Greeting,
    episodes: Episodes,
    /// Decisions with identical candidates since the last one with different candidates.
    identical: AtomicU32,
    is_identity_said: AtomicBool,
}

impl RemotePolicy {
    /// Connects once to read the server's metadata. Blocks; must not be called from an async runtime.
    pub fn connect(address: Address, options: ClientOptions) -> Result<RemotePolicy> {
        let place = address.to_string();
        let connect = || RemotePolicy::try_connect(address, options);
        connect().with_context(|| format!("policy server {place}"))
    }

    fn try_connect(address: Address, options: ClientOptions) -> Result<RemotePolicy> {
        let runtime = Builder::new_multi_thread().worker_threads(THREADS).enable_all().build();
        let runtime = runtime.context("cannot start the async runtime")?;
        let wire = address.wire;
        let default = if wire == Wire::VlaEval { "simpler" } else { "bridge" };
        let chosen = options.profile.as_deref();
        let profile = Profile::load(chosen.unwrap_or(default))?;
        profile.check_wire(wire)?;
        let mut target = Target { address, key: options.key, profile };
        let (_, greeting) = runtime.block_on(Connection::open(&target))?;
        let mut profile_name = chosen.unwrap_or(default).to_owned();
        if let Some(announced) = &greeting.announcement {
            if chosen.is_none() {
                target.profile = Profile::load(PROFILE_ANNOUNCED)?;
                PROFILE_ANNOUNCED.clone_into(&mut profile_name);
            }
            target.profile = target.profile.clone().adapted(announced)?;
        }
        let info = info(&target, &greeting)?;
        let shared = Arc::new(Shared {
            target,
            greeting,
            episodes: Episodes::default(),
            identical: AtomicU32::new(0),
            is_identity_said: AtomicBool::new(false),
        });
        runtime.spawn(end_finished(Arc::downgrade(&shared)));
        Ok(RemotePolicy { shared, info, profile_name, runtime: Some(runtime) })
    }

    /// The server's address.
    pub fn address(&self) -> &Address {
        &self.shared.target.address
    }

    /// Name or file of the profile in use.
    pub fn profile_name(&self) -> &str {
        &self.profile_name
    }

    /// Identity of the profile in use: part of what determines a run's results.
    pub fn profile_digest(&self) -> Result<String> {
        self.shared.target.profile.digest()
    }

    /// What the server announced of the optional fields.
    pub fn announcement(&self) -> Option<&Announcement> {
        self.shared.greeting.announcement.as_ref()
    }
}

impl Drop for RemotePolicy {
    /// A runtime must not be dropped where a caller's runtime runs.
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

#[async_trait]
impl Policy for RemotePolicy {
    fn info(&self) -> &PolicyInfo {
        &self.info
    }

    fn check(&self, setting: &Setting) -> Result<()> {
        let Setting { strategy, candidates, temperature } = *setting;
        let place = self.address();
        let answers = self.shared.target.profile.server.answers;
        if strategy.needs_verifier() {
            ensure!(
                self.info.hidden_size.is_some(),
                "strategy {strategy}: expected a policy that exposes hidden states and log-probabilities, but {place} \
                 does not announce all of digest, hidden_size, confidence_size and action_scale; --backbone included lets \
                 a checkpoint read its candidates instead; sample, first-well-formed, majority and medoid need none"
            );
        }
        let Some(announced) = self.announcement() else {
            connections_wanted(place.wire, candidates as usize)?;
            if strategy == Strategy::Greedy || temperature == 0.0 {
                let name = self.profile_name();
                ensure!(
                    answers == Answers::Greedy,
                    "{setting}: {place} does not announce that it can decode greedily; if it always gives its most \
                     likely action, say so in the profile: [server] answers = \"greedy\" (now {name} says \"sampled\")"
                );
                return Ok(());
            }
            ensure!(
                temperature == 1.0,
                "{setting}: {place} takes no temperature; expected --temperature 1, which stands for the server's own \
                 sampling"
            );
            return Ok(());
        };
        ensure!(
            candidates as usize <= announced.candidates_max,
            "{setting}: {place} gives at most {} candidates",
            announced.candidates_max
        );
        ensure!(
            temperature != 0.0 || announced.is_greedy,
            "{setting}: {place} does not announce that it can decode greedily"
        );
        Ok(())
    }

    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        let runtime = self.runtime.as_ref().context("the policy is closed")?;
        // Their connections must not take places that new episodes need.
        self.shared.episodes.end_finished().await;
        let asked: Vec<_> = requests
            .iter()
            .map(|request| {
                let session = self.shared.episodes.session(request.episode);
                let (question, count) = self.shared.question(request);
                let (shared, seed) = (Arc::clone(&self.shared), request.seed);
                let candidates = request.candidates;
                runtime.spawn(async move {
                    let mut session = session.lock().await;
                    let Shared { target, greeting, .. } = &*shared;
                    let replies = session.ask(target, greeting, &question, (seed, count)).await?;
                    drop(session);
                    shared.proposal(replies, candidates)
                })
            })
            .collect();
        let mut proposals = Vec::with_capacity(asked.len());
        let mut first_error = None;
        for one in asked {
            match one.await.context("the client failed").and_then(|proposal| proposal) {
                Ok(proposal) => proposals.push(proposal),
                // The others are waited for: what they ask must not be asked twice at the same time.
                Err(error) => drop(first_error.get_or_insert(error)),
            }
        }
        match first_error {
            Some(error) => Err(error),
            None => Ok(proposals),
        }
    }
}

impl Shared {
    /// What is sent for a request, and how often.
    fn question(&self, request: &ProposalRequest<'_>) -> (Question, usize) {
        let announced = self.greeting.announcement.as_ref();
        let is_openpi = self.target.address.wire == Wire::OpenPi;
        let ask = announced.map(|_| Ask {
            candidates: Some(request.candidates),
            temperature: Some(request.temperature),
            seed: Some(request.seed),
            episode: request.episode.filter(|_| is_openpi).map(|token| {
                let name = token.name();
                format!("{}/{}/{:x}", name.task, name.episode, token.key())
            }),
        });
        let question = Question {
            image: request.image.clone(),
            state: request.state.to_vec(),
            instruction: request.instruction.to_owned(),
            ask,
        };
        (question, if announced.is_some() { 1 } else { request.candidates })
    }

    fn proposal(&self, replies: Vec<super::connection::Reply>, count: usize) -> Result<Proposal> {
        let profile = &self.target.profile;
        let place = &self.target.address;
        let read = || match &self.greeting.announcement {
            Some(announced) => {
                let reply = replies.into_iter().next().context("expected an answer")?;
                of_answer(profile, announced, reply, count)
            }
            None => replies.iter().map(|reply| of_actions(profile, &reply.actions)).collect(),
        };
        let candidates: Vec<_> = read().with_context(|| format!("{place}"))?;
        self.note_identical(are_identical(&candidates), candidates.len());
        Ok(Proposal { candidates })
    }

    /// A deterministic server has no candidates to choose from.
    fn note_identical(&self, are_identical: bool, count: usize) {
        if count < 2 {
            return;
        }
        if !are_identical {
            self.identical.store(0, Ordering::Relaxed);
            return;
        }
        let decisions = self.identical.fetch_add(1, Ordering::Relaxed) + 1;
        if decisions >= IDENTICAL_DECISIONS && !self.is_identity_said.swap(true, Ordering::Relaxed)
        {
            tracing::warn!(
                "{}: in {decisions} decisions all {count} answers were identical: the server is deterministic, so \
                 there is nothing to choose from",
                self.target.address
            );
        }
    }
}

async fn end_finished(shared: std::sync::Weak<Shared>) {
    let mut ticks = interval(END_INTERVAL);
    loop {
        ticks.tick().await;
        let Some(shared) = shared.upgrade() else { return };
        shared.episodes.end_finished().await;
    }
}

fn info(target: &Target, greeting: &Greeting) -> Result<PolicyInfo> {
    let announced = greeting.announcement.as_ref();
    let profile = &target.profile;
    let digest = match announced.and_then(|announced| announced.digest.clone()) {
        Some(digest) => digest,
        None => digest(target, greeting)?,
    };
    Ok(PolicyInfo {
        digest,
        image_size: (profile.camera.height, profile.camera.width),
        action_space: profile.actions.space(),
        hidden_size: announced.filter(|one| one.has_hidden()).and_then(|one| one.hidden_size),
        parallel_calls: PARALLEL_CALLS,
    })
}

/// Identity of what can be known of a server that announces none: wire, profile and metadata. The
/// weights behind the same metadata may change.
fn digest(target: &Target, greeting: &Greeting) -> Result<String> {
    let digest = Sha256::new()
        .chain_update(target.address.wire.scheme())
        .chain_update([0])
        .chain_update(target.profile.digest()?)
        .chain_update([0])
        .chain_update(&greeting.bytes)
        .finalize();
    Ok(format!("{digest:x}"))
}
