//! Worker pools of one thread each. Each pool decodes its own requests, so that threads do not
//! share a matrix product.
//!
//! A decode step consists of dozens of small products. If threads share each product, they
//! synchronise after each one. If they divide the sessions, they synchronise once per decision; if
//! they divide the calls, never. The results are bitwise equal, because a row's result does not
//! depend on other rows.

use std::sync::{Mutex, PoisonError};
use std::thread;

use anyhow::{Context as _, Result, anyhow};
use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::generate::decode_loop::{Completion, Continuation, Limits, complete};
use crate::kernels::backend::Backend;
use crate::network::forward::Network;

/// Minimum batch of a pool: below it, re-reading the weights dominates.
const POOL_CANDIDATES_MIN: usize = 8;

/// One single-threaded pool per core.
pub struct WorkerPools {
    pools: Vec<ThreadPool>,
    /// Number of calls that currently use each pool.
    calls: Mutex<Vec<usize>>,
}

/// The pools reserved by one call, released on drop.
struct Reserved<'a> {
    pools: Vec<usize>,
    /// The call uses all threads for each product instead of single-threaded pools.
    is_undivided: bool,
    of: &'a WorkerPools,
}

impl WorkerPools {
    /// Pools for the CPU kernels; none if a GPU computes.
    pub fn new(backend: Backend) -> Result<WorkerPools> {
        let count = match backend {
            Backend::Kernels => rayon::current_num_threads(),
            Backend::Tensors(_) => 0,
        };
        let one = |_| ThreadPoolBuilder::new().num_threads(1).build();
        let pools = (0..count).map(one).collect::<Result<_, _>>();
        let pools = pools.context("cannot start the policy's threads")?;
        Ok(WorkerPools { pools, calls: Mutex::new(vec![0; count]) })
    }

    /// Number of pools.
    pub fn count(&self) -> usize {
        self.pools.len()
    }

    /// All completions, ordered by session and then by candidate. If other calls are running, the
    /// call uses the least used pool; otherwise it uses as many pools as its batch size justifies.
    pub fn complete(
        &self,
        network: &Network,
        sessions: &[Continuation<'_>],
        limits: &Limits<'_>,
    ) -> Result<Vec<Completion>> {
        let candidates: usize = sessions.iter().map(|session| session.candidates).sum();
        let wanted = (candidates / POOL_CANDIDATES_MIN).min(sessions.len());
        let reserved = self.reserve(wanted.min(rayon::current_num_threads()));
        if reserved.is_undivided {
            // Called from outside the thread pool, each of the many products would wake a thread
            // and wait for it.
            return rayon::scope(|_| complete(network, sessions, limits));
        }
        let count = reserved.pools.len();
        let run = |part: usize| -> Result<Vec<Completion>> {
            let start = part * sessions.len() / count;
            let own = &sessions[start..(part + 1) * sessions.len() / count];
            let pool = &self.pools[reserved.pools[part]];
            let mut completions = pool.install(|| complete(network, own, limits))?;
            completions.iter_mut().for_each(|completion| completion.session += start);
            Ok(completions)
        };
        let run = &run;
        let parts = thread::scope(|scope| {
            let threads: Vec<_> = (0..count).map(|part| scope.spawn(move || run(part))).collect();
            let join = |thread: thread::ScopedJoinHandle<'_, _>| {
                thread.join().unwrap_or_else(|_| Err(anyhow!("a worker of the policy panicked")))
            };
            threads.into_iter().map(join).collect::<Result<Vec<_>>>()
        })?;
        Ok(parts.into_iter().flatten().collect())
    }

    fn reserve(&self, wanted: usize) -> Reserved<'_> {
        let mut calls = self.calls.lock().unwrap_or_else(PoisonError::into_inner);
        let is_alone = calls.iter().all(|&calls| calls == 0);
        let is_undivided = is_alone && wanted < 2;
        let mut pools: Vec<usize> = (0..calls.len()).collect();
        pools.sort_by_key(|&pool| calls[pool]);
        match (is_undivided, is_alone) {
            (true, _) => {}
            (false, true) => pools.truncate(wanted),
            (false, false) => pools.truncate(1),
        }
        pools.iter().for_each(|&pool| calls[pool] += 1);
        Reserved { pools, is_undivided, of: self }
    }
}

impl Drop for Reserved<'_> {
    fn drop(&mut self) {
        let mut calls = self.of.calls.lock().unwrap_or_else(PoisonError::into_inner);
        self.pools.iter().for_each(|&pool| calls[pool] -= 1);
    }
}
