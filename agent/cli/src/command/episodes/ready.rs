//! Policy, verifier and settings of a run, checked against each other before anything is started.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Result, bail};
use decision::{Policy, Setting};
use runtime::servers::Host;
use serde_json::Value;
use verifier::Verifier;
use vla::Vla;

use super::{EpisodesArguments, Request};
use crate::command::policy::{LoadedPolicy, verifier_beside};
use crate::command::recorded_policy::ServedPolicy;
use crate::command::{WrongUsage, policy_server};
use crate::files::VERIFIER_FILE;

/// What decides in a run.
pub struct Ready {
    /// Proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// The network that computes in this process, if there is one.
    pub network: Option<Arc<Vla>>,
    /// The settings that can be run.
    pub settings: Vec<Setting>,
    /// Scores candidates.
    pub verifier: Option<Arc<Verifier>>,
    /// What the run's header says of a policy server.
    pub server: Option<Value>,
    /// What its candidates are read with.
    pub served: Option<ServedPolicy>,
}

impl EpisodesArguments {
    /// Loads the policy and its verifier.
    pub fn ready(&self, request: &Request, host: &Host) -> Result<Ready> {
        let remote = self.policy.connect(host)?;
        let folder = match remote {
            Some(_) => None,
            None => Some(self.policy.source.folder(host)?),
        };
        let server = remote.as_ref().and_then(|loaded| loaded.server.clone());
        let settings = match &remote {
            Some(LoadedPolicy { policy, .. }) => {
                policy_server::possible(&**policy, &request.settings, request.is_default)?
            }
            None => request.settings.clone(),
        };
        let file = self.verifier_file(folder.as_deref());
        // Before the weights of a checkpoint are loaded, which takes minutes for a large one.
        let settings =
            self.settings(settings, request.is_default, folder.as_deref(), file.is_some())?;
        if settings.is_empty() {
            bail!(WrongUsage(
                "strategies: expected one that the policy can run, got none".to_owned()
            ));
        }
        let wrong_usage = |error: anyhow::Error| WrongUsage(format!("{error:#}"));
        file.as_deref().map(Verifier::load_any).transpose().map_err(wrong_usage)?;
        let loaded = match (remote, folder) {
            (Some(loaded), _) => loaded,
            (None, Some(folder)) => self.policy.load_folder(folder, host)?,
            (None, None) => bail!("expected a folder or a policy server"),
        };
        let network = loaded.network().cloned();
        let policy = loaded.policy;
        let digest = &policy.info().digest;
        let verifier = file.map(|file| Verifier::load(&file, digest).map(Arc::new)).transpose();
        let verifier = verifier.map_err(wrong_usage)?;
        let backbone = self.policy.backbone.as_deref();
        let served = server.as_ref().map(|_| policy_server::served(&*policy, backbone));
        let server = server.as_deref().map(policy_server::header).transpose()?;
        Ok(Ready { policy, network, settings, verifier, server, served })
    }

    /// The file of `--verifier`, or else the one beside the policy's weights unless a published one is followed.
    fn verifier_file(&self, policy: Option<&Path>) -> Option<PathBuf> {
        let beside = || match self.follow_verifier {
            None => policy.and_then(verifier_beside),
            Some(_) => None,
        };
        self.verifier.clone().or_else(beside)
    }

    /// The settings to run. Without a verifier, a setting that needs one is wrong usage, or skipped if it is a default.
    fn settings(
        &self,
        settings: Vec<Setting>,
        is_default: bool,
        policy: Option<&Path>,
        has_verifier: bool,
    ) -> Result<Vec<Setting>> {
        let is_possible = |setting: &Setting| {
            !setting.strategy.needs_verifier() || has_verifier || self.follow_verifier.is_some()
        };
        let Some(setting) = settings.iter().find(|setting| !is_possible(setting)) else {
            return Ok(settings);
        };
        let remedy = match policy {
            Some(policy) => format!(
                "there is no {VERIFIER_FILE} in {}; train one with `rever collect --policy {0}` and `rever train --policy {0}`",
                policy.display()
            ),
            None => "a policy server has no folder with one; `rever train RUN` makes one from a run of `rever collect`".to_owned(),
        };
        if !is_default {
            let strategy = setting.strategy;
            bail!(WrongUsage(format!(
                "strategy {strategy}: expected a verifier (--verifier FILE), got none: {remedy}"
            )));
        }
        eprintln!("skipping strategies that need a verifier: {remedy}");
        Ok(settings.iter().copied().filter(is_possible).collect())
    }
}
