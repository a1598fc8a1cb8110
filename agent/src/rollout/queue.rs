//! What is still to be run: planned episodes that have no record yet.

use std::collections::{BTreeSet, VecDeque};

use crate::record::EpisodeIdentity;
use crate::suite::{Arm, EpisodePlan};

/// Attempts at one episode by one process. A fault that comes back every time is not the server's.
pub const ATTEMPTS_MAX: u32 = 3;

/// One episode to be run with one arm.
#[derive(Debug, Clone)]
pub struct Job {
    /// Which episode, and how.
    pub identity: EpisodeIdentity,
    /// The same as in the identity, parsed.
    pub arm: Arm,
    /// 1 for the first attempt.
    pub attempt: u32,
}

/// Jobs in the order in which they are to be run.
#[derive(Debug)]
pub struct Queue {
    waiting: VecDeque<Job>,
    given_up: Vec<Job>,
}

impl Queue {
    /// Every episode with every arm, episode by episode, so that a partial run is paired; without what is recorded.
    pub fn new(
        run: &str,
        plans: &[EpisodePlan],
        arms: &[Arm],
        recorded: &BTreeSet<String>,
    ) -> Queue {
        let pairs = plans.iter().flat_map(|plan| arms.iter().map(move |arm| (plan, *arm)));
        let jobs =
            pairs.map(|(plan, arm)| Job { identity: identity(run, plan, arm), arm, attempt: 1 });
        let waiting = jobs.filter(|job| !recorded.contains(&job.identity.id())).collect();
        Queue { waiting, given_up: Vec::new() }
    }

    /// Takes the next job.
    pub fn take(&mut self) -> Option<Job> {
        self.waiting.pop_front()
    }

    /// Puts a job back that could not even be begun; it has lost no attempt.
    pub fn put_back(&mut self, job: Job) {
        self.waiting.push_front(job);
    }

    /// Takes back a job that broke: it is run again after the others, or given up.
    pub fn broke(&mut self, job: Job) {
        if job.attempt < ATTEMPTS_MAX {
            self.waiting.push_back(Job { attempt: job.attempt + 1, ..job });
        } else {
            self.given_up.push(job);
        }
    }

    /// Jobs that wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Whether nothing waits.
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Jobs that broke [`ATTEMPTS_MAX`] times.
    pub fn given_up(&self) -> &[Job] {
        &self.given_up
    }
}

fn identity(run: &str, plan: &EpisodePlan, arm: Arm) -> EpisodeIdentity {
    EpisodeIdentity {
        run: run.to_owned(),
        task: plan.task.clone(),
        variant: plan.variant.clone(),
        layout: plan.layout,
        episode: plan.episode,
        seed: plan.seed,
        sampling_seed: plan.sampling_seed,
        strategy: arm.strategy.to_string(),
        candidates: arm.candidates,
        temperature: arm.temperature,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::strategy::Strategy;
    use crate::suite::{Layouts, SeedRange, Suite};

    fn queue(recorded: &[&str]) -> Queue {
        let suite = Suite {
            tasks: vec!["a".into(), "b".into()],
            episodes: 2,
            layouts: Layouts::Grid,
            range: SeedRange::Evaluation,
            seed: 0,
        };
        let arms = Arm::all(&[Strategy::Greedy, Strategy::Verifier], &[1.0], &[5]);
        let recorded = recorded.iter().map(|id| (*id).to_owned()).collect();
        Queue::new("run", &suite.episodes(), &arms, &recorded)
    }

    fn ids(queue: &mut Queue) -> Vec<String> {
        std::iter::from_fn(|| queue.take()).map(|job| job.identity.id()).collect()
    }

    #[test]
    fn arms_of_an_episode_follow_each_other_and_recorded_ones_are_left_out() {
        let all = ids(&mut queue(&[]));
        assert_eq!(all.len(), 8);
        assert_eq!(all[0], "a-default-0000-greedy-n1-t0");
        assert_eq!(all[1], "a-default-0000-verifier-n5-t1");
        assert_eq!(all[2], "b-default-0000-greedy-n1-t0");
        let rest = ids(&mut queue(&[&all[1], &all[6]]));
        assert_eq!(rest, [&all[0], &all[2], &all[3], &all[4], &all[5], &all[7]].map(Clone::clone));
    }

    #[test]
    fn a_job_that_breaks_is_run_again_last_and_given_up_in_the_end() {
        let mut queue = queue(&[]);
        let first = queue.take().expect("a job");
        let id = first.identity.id();
        queue.broke(first);
        assert_eq!(ids_of(&queue).last(), Some(&id));
        for _ in 0..ATTEMPTS_MAX - 1 {
            while let Some(job) = queue.take() {
                if job.identity.id() == id {
                    queue.broke(job);
                    break;
                }
            }
        }
        assert!(queue.is_empty());
        assert_eq!(queue.given_up().iter().map(|job| job.identity.id()).collect::<Vec<_>>(), [id]);
    }

    fn ids_of(queue: &Queue) -> Vec<String> {
        queue.waiting.iter().map(|job| job.identity.id()).collect()
    }
}
