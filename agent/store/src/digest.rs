//! The digest of episodes, to compare builds, machines and record formats.
//!
//! It covers the request and the events of an episode: its identity without the run's name, the
//! tokens of all candidates, choices, statistics and states. It does not cover times, scores,
//! versions or the order of records. Sets of episodes with equal digests had the same course,
//! independent of what wrote their records.

use protocol::Statistics;
use sha2::{Digest, Sha256};

use crate::record::{EpisodeIdentity, EpisodeRecord};

/// The digest of a set of episodes, in hexadecimal. It is computed from the episodes' digests, so
/// that only one record must be in memory at a time.
pub fn combined_digest(mut episodes: Vec<[u8; 32]>) -> String {
    episodes.sort_unstable();
    hex(&Sha256::digest(episodes.concat()))
}

/// The digest of one episode. Numbers are little endian. Texts and lists start with their length in
/// 4 bytes, options with a byte that is 0 or 1.
pub fn episode_digest(record: &EpisodeRecord) -> [u8; 32] {
    let mut hash = Sha256::new();
    add_identity(&mut hash, &record.identity);
    add_statistics(&mut hash, &record.statistics);
    add_length(&mut hash, record.steps.len());
    for step in &record.steps {
        add_length(&mut hash, step.state.len());
        for number in &step.state {
            hash.update(number.to_le_bytes());
        }
        hash.update([u8::from(step.decision.is_some())]);
        if let Some(decision) = &step.decision {
            add_length(&mut hash, decision.candidates.len());
            for candidate in &decision.candidates {
                add_length(&mut hash, candidate.tokens.len());
                for token in &candidate.tokens {
                    hash.update(token.to_le_bytes());
                }
            }
            add_option(&mut hash, decision.chosen);
        }
        add_statistics(&mut hash, &step.statistics);
    }
    hash.finalize().into()
}

/// The bytes in lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn add_identity(hash: &mut Sha256, identity: &EpisodeIdentity) {
    // Destructured, so that the compiler reports a new field.
    let EpisodeIdentity { run: _, task, variant, layout, episode, seed, sampling_seed, .. } =
        identity;
    let EpisodeIdentity { strategy, candidates, temperature, .. } = identity;
    add_text(hash, task);
    add_text(hash, variant);
    add_option(hash, *layout);
    hash.update(episode.to_le_bytes());
    hash.update(seed.to_le_bytes());
    hash.update(sampling_seed.to_le_bytes());
    add_text(hash, strategy);
    hash.update(candidates.to_le_bytes());
    hash.update(temperature.to_le_bytes());
}

fn add_statistics(hash: &mut Sha256, statistics: &Statistics) {
    let Statistics {
        is_success,
        is_grasped,
        ever_grasped,
        consecutive_grasp,
        moved_correct_object,
        moved_wrong_object,
        source_on_target,
        ever_success,
        released_success,
    } = *statistics;
    hash.update([is_success, is_grasped, ever_grasped, consecutive_grasp].map(u8::from));
    hash.update([moved_correct_object, moved_wrong_object, source_on_target].map(u8::from));
    hash.update([ever_success, released_success].map(u8::from));
}

fn add_text(hash: &mut Sha256, text: &str) {
    add_length(hash, text.len());
    hash.update(text);
}

fn add_length(hash: &mut Sha256, length: usize) {
    hash.update((length as u32).to_le_bytes());
}

fn add_option(hash: &mut Sha256, value: Option<u32>) {
    hash.update([u8::from(value.is_some())]);
    if let Some(value) = value {
        hash.update(value.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::tests::made_up;

    fn digest<'a>(records: impl IntoIterator<Item = &'a EpisodeRecord>) -> String {
        combined_digest(records.into_iter().map(episode_digest).collect())
    }

    #[test]
    fn the_digest_never_changes_between_versions() {
        assert_eq!(hex(&episode_digest(&made_up(3))), EPISODE_3);
        assert_eq!(digest([&made_up(3)]), hex(&Sha256::digest(episode_digest(&made_up(3)))));
    }

    #[test]
    fn order_times_scores_versions_and_the_name_of_the_run_do_not_matter() {
        let expected = digest([&made_up(0), &made_up(1)]);
        assert_eq!(digest([&made_up(1), &made_up(0)]), expected);
        let mut other = made_up(1);
        other.identity.run = "other".into();
        other.versions.commit = "beef".into();
        (other.wall_secs, other.steps[0].step_ms) = (99.0, 99.0);
        let decision = other.steps[0].decision.as_mut().expect("a decision");
        decision.candidates[0].score = None;
        assert_eq!(digest([&made_up(0), &other]), expected);
    }

    #[test]
    fn everything_that_happened_in_an_episode_matters() {
        let check = |change: fn(&mut EpisodeRecord)| {
            let mut record = made_up(1);
            change(&mut record);
            assert_ne!(digest([&record]), digest([&made_up(1)]));
        };
        check(|record| record.identity.seed += 1);
        check(|record| record.identity.layout = Some(0));
        check(|record| record.identity.temperature = 0.5);
        check(|record| record.statistics.released_success = true);
        check(|record| record.steps[0].state[7] += 0.5);
        check(|record| record.steps[0].statistics.is_grasped = true);
        check(|record| record.steps[0].decision = None);
        check(|record| record.steps.push(record.steps[0].clone()));
        let decided = |record: &mut EpisodeRecord| record.steps[0].decision.take().expect("one");
        let check_decision = |change: fn(&mut crate::record::DecisionRecord)| {
            let mut record = made_up(1);
            let mut decision = decided(&mut record);
            change(&mut decision);
            record.steps[0].decision = Some(decision);
            assert_ne!(digest([&record]), digest([&made_up(1)]));
        };
        check_decision(|decision| decision.chosen = None);
        check_decision(|decision| decision.candidates[1].tokens[2] += 1);
        check_decision(|decision| {
            let moved = decision.candidates[0].tokens.pop().expect("tokens");
            decision.candidates[1].tokens.insert(0, moved);
        });
    }

    /// Computed independently in Python with `struct.pack` and `hashlib` from the layout above.
    const EPISODE_3: &str = "bd4c4bb66dcc2d2fb297286d6c13d7adde9762001ed39f38c0eb77dd6b432b0c";
}
