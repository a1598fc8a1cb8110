//! Fills the label store: from published outcomes while a run goes on, from its records where those went astray.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;

use store::labels::{Label, LabelStore, episode_id};
use store::record::EpisodeRecord;
use store::run::{self, Run};
use crate::wire::{Network, OutcomeSubscriber};

/// The last outcomes' way to the store.
const LAST_OUTCOMES_WAIT: Duration = Duration::from_secs(10);

/// Labels every recorded episode of a run that has no label yet.
pub fn catch_up(store: &LabelStore, run: &Run) -> Result<()> {
    for id in run::recorded(&run.folder)? {
        if !store.contains(&run.header.run, &id)? {
            let path = run::record_path(&run.folder, &id);
            store.insert(&Label::new(&EpisodeRecord::read(&path)?, &path))?;
        }
    }
    Ok(())
}

/// Reads the outcomes of one run until it is told which ones were the last.
pub struct Collector {
    task: JoinHandle<Result<LabelStore>>,
    last: oneshot::Sender<BTreeSet<String>>,
}

impl Collector {
    /// Subscribes to the outcomes of `run`.
    pub async fn start(network: &Network, run: &Run, store: LabelStore) -> Result<Collector> {
        let subscriber = OutcomeSubscriber::declare(network, Some(&run.header.run)).await?;
        let (last, expected) = oneshot::channel();
        let run = RunPlace { name: run.header.run.clone(), folder: run.folder.clone() };
        let task = tokio::spawn(collect(subscriber, store, run, expected));
        Ok(Collector { task, last })
    }

    /// Waits for the labels of all recorded episodes. A label that does not come is taken from its record.
    pub async fn finish(self, run: &Run) -> Result<()> {
        // When the task is gone already, its error comes out below.
        let _ = self.last.send(run::recorded(&run.folder)?);
        let joined = tokio::time::timeout(LAST_OUTCOMES_WAIT, self.task).await;
        let joined = joined.with_context(|| {
            let secs = LAST_OUTCOMES_WAIT.as_secs();
            format!("the last outcomes did not reach the label store within {secs} s")
        })?;
        let store = joined.context("the label collector panicked")??;
        catch_up(&store, run)
    }
}

/// What a label needs to know of its run.
struct RunPlace {
    name: String,
    folder: PathBuf,
}

async fn collect(
    mut subscriber: OutcomeSubscriber,
    store: LabelStore,
    run: RunPlace,
    mut last: oneshot::Receiver<BTreeSet<String>>,
) -> Result<LabelStore> {
    let mut missing: Option<BTreeSet<String>> = None;
    while missing.as_ref().is_none_or(|missing| !missing.is_empty()) {
        tokio::select! {
            outcome = subscriber.next() => {
                let outcome = outcome?;
                let id = episode_id(&outcome);
                if let Some(missing) = &mut missing {
                    missing.remove(&id);
                }
                let record = Some(run::record_path(&run.folder, &id));
                store.insert(&Label { id, outcome, record })?;
            }
            ids = &mut last, if missing.is_none() => {
                let ids = ids.context("the run ended without a word")?;
                missing = Some(without_labelled(&store, &run.name, ids)?);
            }
        }
    }
    Ok(store)
}

fn without_labelled(
    store: &LabelStore,
    run: &str,
    ids: BTreeSet<String>,
) -> Result<BTreeSet<String>> {
    let mut missing = BTreeSet::new();
    for id in ids {
        if !store.contains(run, &id)? {
            missing.insert(id);
        }
    }
    Ok(missing)
}
