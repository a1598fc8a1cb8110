//! Splits episodes into training, validation and held-out parts by initial layout.
//!
//! Two collections with the same seed start from the same layouts, and the layout has a large
//! effect on the outcome. A split by episode would measure how well layouts are memorised, and a
//! split by sample even how well episodes are memorised.

use std::collections::BTreeMap;

use decision::TaskId;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::set::{LayoutKey, TrainingEpisode};

/// A stratum with at least this many layouts has one in every part.
const LAYOUTS_MIN: usize = 3;

/// Indices of episodes in each part; no layout is in two parts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Split {
    /// The network is fitted to these.
    pub training: Vec<usize>,
    /// The loss on these stops the training.
    pub validation: Vec<usize>,
    /// These are used neither for fitting nor for selection.
    pub held_out: Vec<usize>,
}

/// Takes the shares of the layouts of every task, separately for mostly successful and mostly
/// failed layouts, rounded to whole layouts.
pub fn split(
    episodes: &[TrainingEpisode],
    validation_share: f64,
    held_out_share: f64,
    seed: u64,
) -> Split {
    let mut strata: BTreeMap<(&TaskId, bool), Vec<Vec<usize>>> = BTreeMap::new();
    for (start, group) in by_layout(episodes.iter().map(|episode| &episode.start)) {
        let successes = group.iter().filter(|index| episodes[**index].is_success).count();
        let is_success = 2 * successes >= group.len();
        strata.entry((&start.task, is_success)).or_default().push(group);
    }
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut split = Split::default();
    for mut stratum in strata.into_values() {
        stratum.shuffle(&mut random);
        let layouts = stratum.len();
        let count = |share: f64| {
            let least = usize::from(layouts >= LAYOUTS_MIN);
            ((layouts as f64 * share).round() as usize).max(least)
        };
        let mut groups = stratum.into_iter();
        split.held_out.extend(groups.by_ref().take(count(held_out_share)).flatten());
        split.validation.extend(groups.by_ref().take(count(validation_share)).flatten());
        split.training.extend(groups.flatten());
    }
    split
}

/// Assigns episodes to folds by their layouts; returns the fold of each.
pub fn folds<'a>(
    starts: impl Iterator<Item = &'a LayoutKey>,
    folds: usize,
    seed: u64,
) -> Vec<usize> {
    let mut groups: Vec<Vec<usize>> = by_layout(starts).into_values().collect();
    groups.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    let mut dealt = vec![0; groups.iter().map(Vec::len).sum()];
    for (group, members) in groups.iter().enumerate() {
        members.iter().for_each(|index| dealt[*index] = group % folds);
    }
    dealt
}

/// The indices of each layout.
fn by_layout<'a>(
    starts: impl Iterator<Item = &'a LayoutKey>,
) -> BTreeMap<&'a LayoutKey, Vec<usize>> {
    let mut groups: BTreeMap<&LayoutKey, Vec<usize>> = BTreeMap::new();
    for (index, start) in starts.enumerate() {
        groups.entry(start).or_default().push(index);
    }
    groups
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::training::set::tests::episode;

    /// `repeats` episodes of each of `layouts` layouts, of which the first `successes` layouts
    /// succeed.
    fn episodes(
        task: &str,
        layouts: usize,
        successes: usize,
        repeats: usize,
    ) -> Vec<TrainingEpisode> {
        let one = |(layout, repeat): (usize, usize)| {
            let name = format!("{task} {layout} {repeat}");
            episode(&name, task, layout as u64, layout < successes)
        };
        let all = (0..layouts).flat_map(|layout| (0..repeats).map(move |repeat| (layout, repeat)));
        all.map(one).collect()
    }

    #[test]
    fn a_split_takes_its_shares_of_every_task_and_outcome() {
        let episodes = [episodes("a", 30, 20, 1), episodes("b", 45, 5, 1)].concat();
        let shares = split(&episodes, 0.1, 0.2, 9);
        let count = |side: &[usize], task: &str, is_success: bool| {
            let side = side.iter().map(|index| &episodes[*index]);
            side.filter(|one| one.start.task.task == task && one.is_success == is_success).count()
        };
        let counts = |side: &[usize]| {
            [("a", true), ("a", false), ("b", true), ("b", false)]
                .map(|(task, is_success)| count(side, task, is_success))
        };
        assert_eq!(counts(&shares.held_out), [4, 2, 1, 8]);
        assert_eq!(counts(&shares.validation), [2, 1, 1, 4]);
        let sides = [&shares.training, &shares.validation, &shares.held_out];
        let mut all: Vec<usize> = sides.into_iter().flatten().copied().collect();
        all.sort_unstable();
        assert_eq!(all, (0..75).collect::<Vec<_>>(), "every episode is in one part");
        assert_eq!(shares, split(&episodes, 0.1, 0.2, 9));
        assert_ne!(shares, split(&episodes, 0.1, 0.2, 10));
    }

    #[test]
    fn no_layout_is_in_two_parts_or_in_two_folds() {
        let mut episodes = episodes("a", 40, 20, 3);
        // Repeats of a layout may have different outcomes.
        episodes.iter_mut().step_by(4).for_each(|episode| episode.is_success ^= true);
        let shares = split(&episodes, 0.2, 0.3, 1);
        let seeds = |side: &[usize]| -> BTreeSet<u64> {
            side.iter().map(|index| episodes[*index].start.seed).collect()
        };
        let sides =
            [&shares.training, &shares.validation, &shares.held_out].map(|side| seeds(side));
        assert!(sides.iter().all(|side| !side.is_empty()));
        assert_eq!(sides.iter().map(BTreeSet::len).sum::<usize>(), 40);
        let folds = folds(episodes.iter().map(|episode| &episode.start), 5, 1);
        for (one, fold) in episodes.iter().zip(&folds) {
            let twins = episodes.iter().zip(&folds).filter(|(other, _)| other.start == one.start);
            assert!(twins.map(|(_, fold)| fold).all(|other| other == fold));
        }
        assert_eq!(
            (0..5).map(|fold| folds.iter().filter(|one| **one == fold).count()).max(),
            Some(24)
        );
    }

    #[test]
    fn layouts_differ_by_variant_layout_and_seed() {
        let base = episode("a", "stack", 1, true).start;
        let wide = LayoutKey { task: TaskId::new("stack", "wide"), ..base.clone() };
        let second = LayoutKey { layout: Some(2), ..base.clone() };
        let other = LayoutKey { seed: 2, ..base.clone() };
        assert_eq!(by_layout([&base, &wide, &second, &other, &base].into_iter()).len(), 4);
    }

    #[test]
    fn three_layouts_are_enough_for_three_parts() {
        let shares = split(&episodes("a", 3, 3, 1), 0.1, 0.2, 0);
        assert_eq!(
            (shares.training.len(), shares.validation.len(), shares.held_out.len()),
            (1, 1, 1)
        );
    }
}
