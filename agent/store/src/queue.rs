//! What is still to be run: planned episodes that have no record yet.

use std::collections::{BTreeSet, VecDeque};

use decision::Setting;

use crate::plan::EpisodePlan;
use crate::record::EpisodeIdentity;

/// Attempts at one episode by one process. A fault that comes back every time is not the server's.
pub const ATTEMPTS_MAX: u32 = 3;

/// One episode to be run with one setting.
#[derive(Debug, Clone)]
pub struct Job {
    /// Which episode, and how.
    pub identity: EpisodeIdentity,
    /// The same as in the identity, parsed.
    pub setting: Setting,
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
    /// Every episode with every setting, episode by episode, so that a partial run is paired; without what is recorded.
    pub fn new(
        run: &str,
        plans: &[EpisodePlan],
        settings: &[Setting],
        recorded: &BTreeSet<String>,
    ) -> Queue {
        let pairs = plans.iter().flat_map(|plan| settings.iter().map(move |setting| (plan, *setting)));
        let jobs =
            pairs.map(|(plan, setting)| Job { identity: identity(run, plan, setting), setting, attempt: 1 });
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

fn identity(run: &str, plan: &EpisodePlan, setting: Setting) -> EpisodeIdentity {
    EpisodeIdentity {
        run: run.to_owned(),
        task: plan.task.task.clone(),
        variant: plan.task.variant.clone(),
        layout: plan.layout,
        episode: plan.episode,
        seed: plan.seed,
        sampling_seed: plan.sampling_seed,
        strategy: setting.strategy.to_string(),
        candidates: setting.candidates,
        temperature: setting.temperature,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use decision::{Strategy, TaskId};

    fn queue(recorded: &[&str]) -> Queue {
        let plan = |(episode, task): (u32, &str)| EpisodePlan {
            task: TaskId::default_of(task),
            layout: Some(episode),
            episode,
            seed: 3,
            sampling_seed: 4,
        };
        let plans = [(0, "a"), (0, "b"), (1, "a"), (1, "b")].map(plan);
        let settings = Setting::all(&[Strategy::Greedy, Strategy::Verifier], &[1.0], &[5]);
        let recorded = recorded.iter().map(|id| (*id).to_owned()).collect();
        Queue::new("run", &plans, &settings, &recorded)
    }

    fn ids(queue: &mut Queue) -> Vec<String> {
        std::iter::from_fn(|| queue.take()).map(|job| job.identity.id()).collect()
    }

    #[test]
    fn settings_of_an_episode_follow_each_other_and_recorded_ones_are_left_out() {
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
