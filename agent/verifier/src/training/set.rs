//! The samples for training a verifier, grouped by episode.

use anyhow::{bail, ensure};
use decision::TaskId;

use super::decision_sample::DecisionSample;
use super::split::{self, Split};

/// The start of an episode. Episodes with the same start share most of what determines their
/// outcome, so they are never in different parts of a split.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LayoutKey {
    /// The task and its variant.
    pub task: TaskId,
    /// Number of the fixed initial layout; `None` for one generated from `seed`.
    pub layout: Option<u32>,
    /// Seed of the environment.
    pub seed: u64,
}

/// One finished episode for training.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingEpisode {
    /// Name for messages; unique in a set.
    pub name: String,
    /// The start of the episode.
    pub start: LayoutKey,
    /// The language instruction for the robot.
    pub instruction: String,
    /// The outcome at the last step: the label of all its samples.
    pub is_success: bool,
    /// (samples, input size), row by row: the executed candidates' last hidden states.
    pub hidden: Vec<f32>,
    /// The control step of each sample; a step in which the robot held still has no sample.
    pub steps: Vec<usize>,
    /// Number of control steps of the episode.
    pub steps_total: usize,
    /// The task's horizon in control steps.
    pub steps_max: usize,
    /// One decision per sample; `None` unless there were several candidates with hidden states.
    pub decisions: Option<Vec<DecisionSample>>,
}

impl TrainingEpisode {
    /// Whether the other episode had the same course.
    fn is_repeated_by(&self, other: &TrainingEpisode) -> bool {
        (self.is_success, &self.steps, &self.hidden)
            == (other.is_success, &other.steps, &other.hidden)
    }
}

/// Training episodes of one policy.
#[derive(Clone, Debug)]
pub struct TrainingSet {
    input_size: usize,
    action_length: usize,
    episodes: Vec<TrainingEpisode>,
    repeats: usize,
}

impl TrainingSet {
    /// Collects episodes of a policy with these sizes of hidden states and actions. They are
    /// sorted, so that the order of arrival has no effect. An episode that was run twice with the
    /// same seeds counts once.
    pub fn new(
        input_size: usize,
        action_length: usize,
        episodes: impl IntoIterator<Item = TrainingEpisode>,
    ) -> anyhow::Result<TrainingSet> {
        ensure!(input_size > 0, "hidden states: expected at least one value each");
        let mut episodes: Vec<TrainingEpisode> = episodes.into_iter().collect();
        for episode in &episodes {
            check(episode, input_size, action_length)
                .map_err(|error| error.context(format!("episode {}", episode.name)))?;
        }
        // The name comes last, because it contains a run's random digits: a repeated collection
        // must have the same order.
        episodes.sort_by(|a, b| (&a.start, &a.name).cmp(&(&b.start, &b.name)));
        if let Some(twins) = episodes.windows(2).find(|pair| pair[0].name == pair[1].name) {
            bail!("episode {}: expected only one with this name, got two", twins[0].name);
        }
        let all = episodes.len();
        let mut different: Vec<TrainingEpisode> = Vec::with_capacity(all);
        for episode in episodes {
            let mut of_layout = different.iter().rev().take_while(|one| one.start == episode.start);
            if !of_layout.any(|one| one.is_repeated_by(&episode)) {
                different.push(episode);
            }
        }
        let repeats = all - different.len();
        Ok(TrainingSet { input_size, action_length, episodes: different, repeats })
    }

    /// Length of a hidden state.
    pub fn input_size(&self) -> usize {
        self.input_size
    }

    /// Number of dimensions of an action.
    pub fn action_length(&self) -> usize {
        self.action_length
    }

    /// The episodes, sorted by their start and name.
    pub fn episodes(&self) -> &[TrainingEpisode] {
        &self.episodes
    }

    /// Number of episodes that were left out because they repeat another one.
    pub fn repeats(&self) -> usize {
        self.repeats
    }

    /// Splits the episodes; see [`split::split`].
    pub fn split(&self, validation_share: f64, held_out_share: f64, seed: u64) -> Split {
        split::split(&self.episodes, validation_share, held_out_share, seed)
    }

    /// The hidden states of the given episodes.
    pub fn hidden(&self, episodes: &[usize]) -> impl Iterator<Item = &[f32]> + Clone {
        let episodes = episodes.iter().map(|episode| &self.episodes[*episode]);
        episodes.flat_map(|episode| episode.hidden.chunks_exact(self.input_size))
    }

    /// The label of every sample of the given episodes.
    pub fn labels(&self, episodes: &[usize]) -> Vec<bool> {
        let episodes = episodes.iter().map(|episode| &self.episodes[*episode]);
        episodes.flat_map(|episode| episode.steps.iter().map(|_| episode.is_success)).collect()
    }
}

fn check(episode: &TrainingEpisode, input_size: usize, action_length: usize) -> anyhow::Result<()> {
    let (values, samples) = (episode.hidden.len(), episode.steps.len());
    ensure!(
        values == samples * input_size,
        "expected {samples} hidden states of {input_size} values, got {values} values"
    );
    ensure!(
        episode.hidden.iter().all(|value| value.is_finite()),
        "expected finite hidden states, got NaN or infinity"
    );
    ensure!(
        episode.steps_total <= episode.steps_max,
        "expected at most {} control steps, the task's horizon, got {}",
        episode.steps_max,
        episode.steps_total
    );
    let Some(decisions) = &episode.decisions else { return Ok(()) };
    ensure!(
        decisions.len() == samples,
        "expected {samples} decisions, one per sample, got {}",
        decisions.len()
    );
    for (index, decision) in decisions.iter().enumerate() {
        let DecisionSample { hidden_mean, candidates, .. } = decision;
        ensure!(
            hidden_mean.len() == input_size
                && !candidates.rows().is_empty()
                && candidates.layout().action_length == action_length,
            "decision {index}: expected candidates of {action_length} numbers and a mean of {input_size} values"
        );
    }
    Ok(())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(crate) fn episode(name: &str, task: &str, seed: u64, is_success: bool) -> TrainingEpisode {
        TrainingEpisode {
            name: name.to_owned(),
            start: LayoutKey { task: TaskId::default_of(task), layout: None, seed },
            instruction: String::new(),
            is_success,
            hidden: vec![0.5; 6],
            steps: vec![0, 1, 2],
            steps_total: 3,
            steps_max: 60,
            decisions: None,
        }
    }

    #[test]
    fn labels_are_the_episodes_outcome_for_every_sample() {
        let episodes = [episode("x", "a", 1, true), episode("y", "a", 2, false)];
        let set = TrainingSet::new(2, 7, episodes).expect("a whole set");
        assert_eq!(set.labels(&[1, 0]), [false, false, false, true, true, true]);
        assert_eq!(set.hidden(&[1, 0]).count(), 6);
    }

    #[test]
    fn an_episode_that_was_run_twice_counts_once() {
        let mut other = episode("run-2/x", "a", 1, true);
        other.hidden[0] = 0.25;
        let all = [
            episode("run-1/x", "a", 1, true),
            other,
            episode("run-3/x", "a", 1, true),
            episode("run-1/y", "a", 2, true),
        ];
        let set = TrainingSet::new(2, 7, all).expect("a whole set");
        let names: Vec<&str> = set.episodes().iter().map(|one| one.name.as_str()).collect();
        assert_eq!((names, set.repeats()), (vec!["run-1/x", "run-2/x", "run-1/y"], 1));
    }

    #[test]
    fn broken_episodes_are_refused_by_name() {
        let refuse = |episodes: Vec<TrainingEpisode>| {
            format!("{:#}", TrainingSet::new(2, 7, episodes).expect_err("refused"))
        };
        let broken = |change: fn(&mut TrainingEpisode)| {
            let mut broken = episode("broken", "a", 1, true);
            change(&mut broken);
            refuse(vec![broken])
        };
        assert_eq!(
            broken(|episode| episode.hidden.truncate(5)),
            "episode broken: expected 3 hidden states of 2 values, got 5 values"
        );
        assert_eq!(
            broken(|episode| episode.hidden[3] = f32::NAN),
            "episode broken: expected finite hidden states, got NaN or infinity"
        );
        assert_eq!(
            broken(|episode| episode.steps_max = 2),
            "episode broken: expected at most 2 control steps, the task's horizon, got 3"
        );
        assert_eq!(
            broken(|episode| episode.decisions = Some(Vec::new())),
            "episode broken: expected 3 decisions, one per sample, got 0"
        );
        let twice = vec![episode("same", "a", 1, true), episode("same", "a", 1, false)];
        assert_eq!(refuse(twice), "episode same: expected only one with this name, got two");
    }
}
