//! The agent that is served: a policy, a scorer, a setting, and the batcher that decides for all
//! clients.

use std::sync::Arc;

use anyhow::{Result, ensure};
use batching::DecisionBatcher;
use decision::{
    Decider, EpisodeContext, Policy, PolicyInfo, Scorer, Setting, Strategy, TAGS, sampling_seed,
};
use protocol::Dimension;

use super::action_form::ActionForm;
use super::observation::ObservationKeys;
use crate::codec::extension::{Announcement, Ask};

/// Maximum number of candidates that a client can ask for where memory allows it.
pub const CANDIDATES_MAX: u32 = 16;
/// Maximum temperature that a client can ask for.
const TEMPERATURE_MAX: f32 = 10.0;

/// What is served.
pub struct AgentOptions {
    /// Proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// Scores them, if there is a scorer.
    pub scorer: Option<Arc<dyn Scorer>>,
    /// How candidates are sampled and selected, unless a client asks otherwise.
    pub setting: Setting,
    /// Maximum number of candidates that a client can ask for; at least those of the setting.
    pub candidates_max: u32,
    /// The seed from which those of episodes are derived.
    pub seed: u64,
    /// The convention of the actions that are sent.
    pub form: ActionForm,
    /// Where an observation has the image and the state.
    pub keys: ObservationKeys,
}

/// A running agent, shared by all connections.
pub struct ServedAgent {
    pub(super) options: AgentOptions,
    pub(super) batcher: DecisionBatcher,
    dimensions: Vec<Dimension>,
}

impl ServedAgent {
    /// Starts the background task that decides. Refuses a strategy that cannot be served.
    pub fn start(options: AgentOptions) -> Result<Arc<ServedAgent>> {
        let strategy = options.setting.strategy;
        ensure!(
            !strategy.needs_verifier() || options.scorer.is_some(),
            "strategy {strategy}: expected a verifier, got none"
        );
        ensure!(
            !strategy.needs_expert(),
            "strategy {strategy}: a policy server has no scripted expert; expected another strategy"
        );
        let space = &options.policy.info().action_space;
        options.form.check(space)?;
        let dimensions = space.dimensions();
        let decider = Arc::new(Decider::new(Arc::clone(&options.policy)));
        let batcher = DecisionBatcher::start(decider);
        Ok(Arc::new(ServedAgent { options, batcher, dimensions }))
    }

    pub(super) fn info(&self) -> &PolicyInfo {
        self.options.policy.info()
    }

    /// The state at the start of an episode. Its seed is derived from its name, as in evaluations:
    /// `TASK/VARIANT/NUMBER` there.
    pub(super) fn begin(&self, episode: &str, instruction: &str) -> EpisodeContext {
        EpisodeContext::new(
            self.options.setting,
            sampling_seed(episode, self.options.seed),
            instruction,
            self.options.scorer.clone(),
            &self.dimensions,
        )
    }

    /// The setting of one decision.
    pub(super) fn setting(&self, ask: &Ask) -> Result<Setting> {
        let own = self.options.setting;
        if ask.candidates.is_none() && ask.temperature.is_none() {
            return Ok(own);
        }
        let temperature = ask.temperature.unwrap_or(own.temperature);
        // Greedy decoding has one candidate.
        let own_candidates = if temperature == 0.0 { 1 } else { own.candidates };
        let candidates = ask.candidates.map_or(own_candidates, |count| count as u32);
        let candidates_max = self.candidates_max();
        ensure!(
            (1..=candidates_max).contains(&candidates),
            "rever.candidates: expected 1 to {candidates_max}, got {candidates}"
        );
        ensure!(
            ask.temperature.is_none_or(|asked| (0.0..=TEMPERATURE_MAX).contains(&asked)),
            "rever.temperature: expected 0 to {TEMPERATURE_MAX}, got {temperature}"
        );
        ensure!(
            temperature > 0.0 || candidates == 1,
            "rever.candidates: expected 1 at temperature 0, got {candidates}"
        );
        let setting = Setting::new(self.strategy(candidates), candidates, temperature);
        self.options.policy.check(&setting)?;
        Ok(setting)
    }

    /// With one candidate, a server of greedy actions samples if asked to; with several, the first
    /// well-formed one is sent.
    fn strategy(&self, candidates: u32) -> Strategy {
        use Strategy::{FirstWellFormed, Greedy, Sample};
        match self.options.setting.strategy {
            Greedy | Sample if candidates > 1 => FirstWellFormed,
            Greedy => Sample,
            other => other,
        }
    }

    /// The most candidates that memory and the policy allow.
    fn candidates_max(&self) -> u32 {
        let AgentOptions { setting, candidates_max, policy, .. } = &self.options;
        let most = (*candidates_max).max(setting.candidates);
        let can = |count: &u32| {
            let sampled = Setting::new(Strategy::Medoid, *count, setting.temperature);
            policy.check(&sampled).is_ok()
        };
        (setting.candidates..=most).rev().find(can).unwrap_or(setting.candidates)
    }

    /// What this server adds to the wires.
    pub(super) fn announcement(&self) -> Announcement {
        let info = self.info();
        let greedy = Setting::new(Strategy::Greedy, 1, 0.0);
        Announcement {
            candidates_max: self.candidates_max() as usize,
            digest: Some(info.digest.clone()),
            is_greedy: self.options.policy.check(&greedy).is_ok(),
            image_size: Some(info.image_size).filter(|(height, width)| height * width > 0),
            hidden_size: info.hidden_size,
            confidence_size: info.hidden_size.map(|_| TAGS.len() + info.action_space.length()),
            action_scale: Some(info.action_space.scale.clone()),
        }
    }
}
