//! The samples that a verifier is trained on, kept by episode so that no episode is on both sides of the split.

use std::collections::BTreeMap;

use anyhow::ensure;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;

use super::decision::DecisionSample;

/// One finished episode as the verifier sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledEpisode {
    /// What to call it in a message; unique in a set.
    pub name: String,
    /// Its task.
    pub task: String,
    /// What the robot was told.
    pub instruction: String,
    /// Its outcome at the last step: the label of all its samples.
    pub is_success: bool,
    /// (samples, input size), row by row: the executed candidates' last hidden states.
    pub hidden: Vec<f32>,
    /// The control step of each sample; a step in which the robot held still has none.
    pub steps: Vec<usize>,
    /// Control steps of the episode.
    pub steps_total: usize,
    /// What the decision of each sample was between; none unless the executed candidates were drawn, not chosen.
    pub decisions: Option<Vec<DecisionSample>>,
}

/// Episodes to train on, all of one policy.
#[derive(Clone, Debug)]
pub struct TrainingSet {
    input_size: usize,
    episodes: Vec<LabelledEpisode>,
}

/// Indices of the episodes to fit and of those to judge by.
#[derive(Clone, Debug, PartialEq)]
pub struct Split {
    /// Episodes that the weights are fitted to.
    pub training: Vec<usize>,
    /// Episodes held out.
    pub held_out: Vec<usize>,
}

impl TrainingSet {
    /// Collects episodes in an order of their own, so that the order of arrival makes no difference.
    pub fn new(
        input_size: usize,
        episodes: impl IntoIterator<Item = LabelledEpisode>,
    ) -> anyhow::Result<TrainingSet> {
        ensure!(input_size > 0, "hidden states: expected at least one value each");
        let mut episodes: Vec<LabelledEpisode> = episodes.into_iter().collect();
        for episode in &episodes {
            let (values, samples) = (episode.hidden.len(), episode.steps.len());
            ensure!(
                values == samples * input_size,
                "episode {}: expected {samples} hidden states of {input_size} values, got {values} values",
                episode.name
            );
            let decisions = episode.decisions.as_ref();
            for (index, decision) in decisions.into_iter().flatten().enumerate() {
                ensure!(
                    decision.hidden_mean.len() == input_size && !decision.candidates.is_empty(),
                    "episode {}, decision {index}: expected candidates and a mean of {input_size} values",
                    episode.name
                );
            }
            ensure!(
                decisions.is_none_or(|decisions| decisions.len() == samples),
                "episode {}: expected {samples} decisions, as many as samples",
                episode.name
            );
            ensure!(
                episode.hidden.iter().all(|value| value.is_finite()),
                "episode {}: expected finite hidden states, got NaN or infinity",
                episode.name
            );
        }
        episodes.sort_by(|a, b| (&a.task, &a.name).cmp(&(&b.task, &b.name)));
        if let Some(twins) = episodes.windows(2).find(|pair| pair[0].name == pair[1].name) {
            anyhow::bail!("episode {}: expected once, got twice", twins[0].name);
        }
        Ok(TrainingSet { input_size, episodes })
    }

    /// Length of a hidden state.
    pub fn input_size(&self) -> usize {
        self.input_size
    }

    /// The episodes, sorted by task and name.
    pub fn episodes(&self) -> &[LabelledEpisode] {
        &self.episodes
    }

    /// Holds out a share of the episodes of every task and outcome, rounded to whole episodes.
    ///
    /// Whole episodes: neighbouring steps are nearly the same sample, and a split by sample would measure memory.
    pub fn split(&self, held_out_share: f64, seed: u64) -> Split {
        let mut strata: BTreeMap<(&str, bool), Vec<usize>> = BTreeMap::new();
        for (index, episode) in self.episodes.iter().enumerate() {
            strata.entry((&episode.task, episode.is_success)).or_default().push(index);
        }
        let mut random = StdRng::seed_from_u64(seed);
        let mut split = Split { training: Vec::new(), held_out: Vec::new() };
        for mut stratum in strata.into_values() {
            stratum.shuffle(&mut random);
            let held_out = (stratum.len() as f64 * held_out_share).round() as usize;
            split.held_out.extend(&stratum[..held_out]);
            split.training.extend(&stratum[held_out..]);
        }
        split
    }

    /// The label of every sample of the given episodes.
    pub fn labels(&self, episodes: &[usize]) -> Vec<bool> {
        let episodes = episodes.iter().map(|episode| &self.episodes[*episode]);
        episodes.flat_map(|episode| episode.steps.iter().map(|_| episode.is_success)).collect()
    }

    /// The share of positive samples in the given episodes.
    pub fn positive_share(&self, episodes: &[usize]) -> f64 {
        let labels = self.labels(episodes);
        labels.iter().filter(|label| **label).count() as f64 / labels.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episode(name: &str, task: &str, is_success: bool) -> LabelledEpisode {
        LabelledEpisode {
            name: name.to_owned(),
            task: task.to_owned(),
            instruction: String::new(),
            is_success,
            hidden: vec![0.5; 6],
            steps: vec![0, 1, 2],
            steps_total: 3,
            decisions: None,
        }
    }

    #[test]
    fn a_split_takes_its_share_of_every_task_and_outcome() {
        let of = |task: &str, successes: usize, failures: usize| -> Vec<LabelledEpisode> {
            (0..successes + failures)
                .map(|i| episode(&format!("{task} {i}"), task, i < successes))
                .collect()
        };
        let set =
            TrainingSet::new(2, [of("a", 20, 10), of("b", 5, 40)].concat()).expect("a whole set");
        let split = set.split(0.2, 9);
        let count = |task: &str, is_success: bool| {
            let held_out = split.held_out.iter().map(|index| &set.episodes()[*index]);
            held_out
                .filter(|episode| episode.task == task && episode.is_success == is_success)
                .count()
        };
        assert_eq!(
            (count("a", true), count("a", false), count("b", true), count("b", false)),
            (4, 2, 1, 8)
        );
        let mut all: Vec<usize> = split.training.iter().chain(&split.held_out).copied().collect();
        all.sort_unstable();
        assert_eq!(all, (0..75).collect::<Vec<_>>(), "every episode is on one side");
        assert_eq!(split, set.split(0.2, 9));
        assert_ne!(split, set.split(0.2, 10));
    }

    #[test]
    fn labels_are_the_episodes_outcome_for_every_sample() {
        let set = TrainingSet::new(2, [episode("x", "a", true), episode("y", "a", false)])
            .expect("a whole set");
        assert_eq!(set.labels(&[1, 0]), [false, false, false, true, true, true]);
        assert_eq!(set.positive_share(&[0, 1]), 0.5);
    }

    #[test]
    fn broken_episodes_are_refused_by_name() {
        let refuse = |episodes: Vec<LabelledEpisode>| {
            TrainingSet::new(2, episodes).expect_err("refused").to_string()
        };
        let mut short = episode("short", "a", true);
        short.hidden.pop();
        assert_eq!(
            refuse(vec![short]),
            "episode short: expected 3 hidden states of 2 values, got 5 values"
        );
        let mut broken = episode("broken", "a", true);
        broken.hidden[3] = f32::NAN;
        assert_eq!(
            refuse(vec![broken]),
            "episode broken: expected finite hidden states, got NaN or infinity"
        );
        let twice = vec![episode("same", "a", true), episode("same", "a", false)];
        assert_eq!(refuse(twice), "episode same: expected once, got twice");
    }
}
