//! Worker pools of one thread, each with requests of its own, instead of all threads on each product.
//!
//! A step of the decode loop is dozens of small products. Divided among threads, each of them ends with the threads
//! waiting for each other; divided by session, they wait once per decision. The bits are the same: a row's result does
//! not depend on the rows beside it.

use std::thread;

use anyhow::{Context as _, Result, anyhow};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::generate::decode_loop::{Completion, Continuation, Limits, complete};
use crate::kernels::backend::Backend;
use crate::network::forward::Network;

/// Minimum batch of a pool: below it, re-reading the weights dominates.
const POOL_CANDIDATES_MIN: usize = 16;

/// One pool of a single thread per processor.
pub struct WorkerPools {
    pools: Vec<ThreadPool>,
}

impl WorkerPools {
    /// Pools for kernels on the processor; none where a device computes.
    pub fn new(backend: Backend) -> Result<WorkerPools> {
        let count = match backend {
            Backend::Kernels => rayon::current_num_threads(),
            Backend::Tensors => 0,
        };
        let one = |_| ThreadPoolBuilder::new().num_threads(1).build();
        let pools = (0..count).map(one).collect::<Result<_, _>>();
        Ok(WorkerPools { pools: pools.context("cannot start the policy's threads")? })
    }

    /// All completions, session by session and candidate by candidate.
    pub fn complete(
        &self,
        network: &Network,
        sessions: &[Continuation<'_>],
        limits: &Limits<'_>,
    ) -> Result<Vec<Completion>> {
        let candidates: usize = sessions.iter().map(|session| session.candidates).sum();
        let pools = (candidates / POOL_CANDIDATES_MIN)
            .min(sessions.len())
            .min(self.pools.len())
            .min(rayon::current_num_threads());
        if pools < 2 {
            // From outside of its pool, each of a step's dozens of products would wake a thread and wait for it.
            return rayon::scope(|_| complete(network, sessions, limits));
        }
        let run = |pool: usize| -> Result<Vec<Completion>> {
            let start = pool * sessions.len() / pools;
            let own = &sessions[start..(pool + 1) * sessions.len() / pools];
            let mut completions = self.pools[pool].install(|| complete(network, own, limits))?;
            completions.iter_mut().for_each(|completion| completion.session += start);
            Ok(completions)
        };
        let run = &run;
        let parts = thread::scope(|scope| {
            let threads: Vec<_> = (0..pools).map(|pool| scope.spawn(move || run(pool))).collect();
            let join = |thread: thread::ScopedJoinHandle<'_, _>| {
                thread.join().unwrap_or_else(|_| Err(anyhow!("a worker of the policy panicked")))
            };
            threads.into_iter().map(join).collect::<Result<Vec<_>>>()
        })?;
        Ok(parts.into_iter().flatten().collect())
    }
}
