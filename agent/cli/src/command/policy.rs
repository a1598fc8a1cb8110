//! The policy of `--policy`: its arguments, and how it is loaded. What cannot be used is wrong usage; the message says
//! what to do.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Result;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, ValueEnum};
use decision::Policy;
use remote_policy::{Address, RemotePolicy};
use runtime::servers::{Host, data_folder};
use serde::Deserialize;
use serde_json::{Value, json};
use verifier::Verifier;
use vla::{
    BackbonePolicy, CompletionParser, DeviceName, LoadOptions, Loading, ReasoningMode, Vla,
    WeightFormat,
};

use super::WrongUsage;
use super::loading::LoadingProgress;
use super::policy_server::ServerArguments;
use crate::files::{self, VERIFIER_FILE};

/// The value of `--backbone` for the policy that comes with the program.
const BACKBONE_INCLUDED: &str = "included";

/// Which policy, and what it runs on. The help's heading stays in force after it, so it is the last field of a command.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Policy and verifier")]
pub struct PolicyArguments {
    #[command(flatten)]
    pub source: PolicySource,
    /// Device that the policy runs on: cpu, cuda or cuda:N
    #[arg(long, default_value_t)]
    pub device: DeviceName,
    #[command(flatten)]
    pub server: ServerArguments,
    /// Checkpoint that reads the candidates of a policy server for the verifier, if the server exposes no hidden states:
    /// a folder, or `included` for the policy that comes with rever; --unnorm-key etc. are then this checkpoint's
    #[arg(long, value_name = "FOLDER")]
    pub backbone: Option<PathBuf>,
    /// Bits of the decoder's weights in memory, on a CPU; 8bit halves their memory, makes large checkpoints faster, and
    /// changes some tokens
    #[arg(long, value_enum, default_value_t, value_name = "BITS")]
    pub weights: WeightBits,
    /// Gigabytes for keys and values; --sessions (serve-policy: --max-clients) is lowered to what fits [default: 75 % of the free memory]
    #[arg(long, value_name = "GB", value_parser = gigabytes)]
    pub kv_cache: Option<f64>,
}

/// The format of the decoder's weights in memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum WeightBits {
    /// As in the checkpoint
    #[default]
    #[value(name = "16bit")]
    Sixteen,
    /// Integers with one scale per output
    #[value(name = "8bit")]
    Eight,
}

/// Which policy, and how its files are read.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Policy and verifier")]
pub struct PolicySource {
    /// Folder of the checkpoint, or a policy server: openpi://HOST:PORT, vla-eval://HOST:PORT or http://HOST:PORT/act
    /// [default: the policy that comes with rever]
    #[arg(long, value_name = "FOLDER|URL")]
    pub policy: Option<PathBuf>,
    #[command(flatten)]
    pub checkpoint: CheckpointArguments,
}

/// What a checkpoint's files may leave open.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Policy and verifier")]
pub struct CheckpointArguments {
    /// Dataset whose statistics scale the actions, such as bridge_orig; needed if the checkpoint has several
    #[arg(long, value_name = "DATASET")]
    pub unnorm_key: Option<String>,
    /// Whether the checkpoint writes a chain of thought before its action, as ECoT does
    #[arg(long, default_value_t, value_name = "MODE",
          value_parser = PossibleValuesParser::new(ReasoningMode::ALL.map(ReasoningMode::name))
              .try_map(|mode| mode.parse::<ReasoningMode>()))]
    pub reasoning: ReasoningMode,
    /// Prompt of the policy, with {instruction} once [default: that of the checkpoint's family]
    #[arg(long, value_name = "TEXT")]
    pub prompt: Option<String>,
    /// Maximum tokens of a completion [default: the checkpoint's limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub max_new_tokens: Option<u32>,
    /// Crop images to the central 90 % of their area, for checkpoints that were fine-tuned with random crops (LIBERO)
    #[arg(long)]
    pub center_crop: bool,
}

/// A policy that is ready to decide.
pub struct LoadedPolicy {
    /// Proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// The same policy, if it is a local checkpoint.
    pub checkpoint: Option<Arc<Vla>>,
    /// The checkpoint's folder, which may hold a verifier.
    pub folder: Option<PathBuf>,
    /// The policy server, if the policy is one.
    pub server: Option<Arc<RemotePolicy>>,
    /// The checkpoint that reads the policy server's candidates, if there is one.
    pub backbone: Option<Arc<Vla>>,
    /// The name to show: a folder or an address.
    pub name: String,
}

impl PolicyArguments {
    /// Loads the policy, or the one that comes with the program.
    pub fn load(&self, host: &Host) -> Result<LoadedPolicy> {
        if let Some(loaded) = self.connect(host)? {
            return Ok(loaded);
        }
        self.load_folder(self.source.folder(host)?, host)
    }

    /// Connects to the policy server, if the policy is one.
    pub fn connect(&self, host: &Host) -> Result<Option<LoadedPolicy>> {
        let Some(address) = self.source.address() else {
            return Ok(None);
        };
        let options = self.source.checkpoint.words();
        if !options.is_empty() && self.backbone.is_none() {
            return Err(WrongUsage(format!(
                "{}: expected a checkpoint's folder, got the policy server {address}, which has its own options",
                options.trim()
            ))
            .into());
        }
        let connected = self.server.connect(&address, host)?;
        self.with_backbone(connected, host).map(Some)
    }

    /// The policy server with the backbone that reads its candidates, if one is given.
    fn with_backbone(&self, connected: LoadedPolicy, host: &Host) -> Result<LoadedPolicy> {
        let Some(backbone) = &self.backbone else { return Ok(connected) };
        let named = Some(backbone).filter(|name| name.as_os_str() != BACKBONE_INCLUDED);
        let folder = files::policy_folder(named, host)?;
        ensure_folder(&folder, "--backbone")?;
        let options = self.source.checkpoint.options();
        let backbone = Arc::new(self.load_checkpoint(&folder, &options, host)?);
        let policy = BackbonePolicy::new(connected.policy, Arc::clone(&backbone));
        let policy = Arc::new(policy.map_err(wrong_usage)?);
        Ok(LoadedPolicy { policy, backbone: Some(backbone), ..connected })
    }

    /// The arguments of this policy for a further command, with a space before them.
    pub fn words(&self) -> String {
        let backbone = self.backbone.iter();
        let backbone: String =
            backbone.map(|name| format!(" --backbone {}", name.display())).collect();
        self.source.words() + &self.server.words() + &backbone
    }

    /// Loads the checkpoint in a folder that [`PolicySource`] has chosen.
    pub fn load_folder(&self, folder: PathBuf, host: &Host) -> Result<LoadedPolicy> {
        self.server.ensure_unused()?;
        if self.backbone.is_some() {
            return Err(WrongUsage(
                "--backbone: expected a policy server, got a checkpoint, which has hidden states of its own".to_owned(),
            )
            .into());
        }
        ensure_folder(&folder, "--policy")?;
        let options = self.source.checkpoint.options();
        let policy = Arc::new(self.load_checkpoint(&folder, &options, host)?);
        Ok(LoadedPolicy {
            policy: Arc::clone(&policy) as Arc<dyn Policy>,
            checkpoint: Some(policy),
            server: None,
            backbone: None,
            name: folder.display().to_string(),
            folder: Some(folder),
        })
    }

    fn load_checkpoint(&self, folder: &Path, options: &LoadOptions, host: &Host) -> Result<Vla> {
        let progress = LoadingProgress::new(folder.display().to_string());
        let digests = data_folder(host).map(|data| data.join("digests"));
        let loading = Loading {
            device: self.device,
            weights: self.weights.format(),
            digests: digests.as_deref(),
            report: &|loaded| progress.report(loaded),
        };
        let policy = Vla::load_with(folder, options, &loading).map_err(wrong_usage)?;
        progress.finish();
        Ok(policy)
    }
}

impl WeightBits {
    fn format(self) -> WeightFormat {
        match self {
            WeightBits::Sixteen => WeightFormat::Exact,
            WeightBits::Eight => WeightFormat::Eight,
        }
    }

    /// The value for the header of a run; `None` for the default.
    pub fn header(self) -> Option<Value> {
        (self != WeightBits::default()).then(|| json!("8bit"))
    }
}

impl PolicySource {
    /// The address of the policy server, if the policy is meant as one.
    pub fn address(&self) -> Option<String> {
        let text = self.policy.as_ref()?.to_str()?;
        Address::is_meant(text).then(|| text.to_owned())
    }

    /// The folder of the checkpoint, or of the one that comes with the program.
    pub fn folder(&self, host: &Host) -> Result<PathBuf> {
        if let Some(address) = self.address() {
            return Err(WrongUsage(format!(
                "--policy: expected a checkpoint's folder, got the policy server {address}"
            ))
            .into());
        }
        let folder = files::policy_folder(self.policy.as_ref(), host)?;
        ensure_folder(&folder, "--policy")?;
        Ok(folder)
    }

    /// Loads what reads the records of a run with these policy options in its header, made with a policy of this
    /// digest. Options of the command line take precedence. Needs no weights.
    pub fn parser_of_run(
        &self,
        recorded: Option<&Value>,
        digest: &str,
        host: &Host,
    ) -> Result<CompletionParser> {
        let folder = self.folder(host)?;
        let options = match (self.checkpoint.header(), recorded) {
            (None, Some(recorded)) => LoadOptions::deserialize(recorded)?,
            _ => self.checkpoint.options(),
        };
        CompletionParser::load_for_records(&folder, &options, digest).map_err(wrong_usage)
    }

    /// Loads what reads the checkpoint's completions, without the network.
    pub fn parser(&self, host: &Host) -> Result<CompletionParser> {
        let folder = self.folder(host)?;
        CompletionParser::load(&folder, &self.checkpoint.options()).map_err(wrong_usage)
    }

    /// The arguments of this policy for a further command, with a space before them; empty for the policy that comes
    /// with the program.
    pub fn words(&self) -> String {
        let folder = self.policy.as_ref().map(|folder| folder.display().to_string());
        let policy = folder.map_or_else(String::new, |folder| format!(" --policy {folder}"));
        policy + &self.checkpoint.words()
    }
}

impl CheckpointArguments {
    /// The options as the checkpoint's loader takes them.
    pub fn options(&self) -> LoadOptions {
        LoadOptions {
            unnorm_key: self.unnorm_key.clone(),
            reasoning: self.reasoning,
            prompt: self.prompt.clone(),
            max_new_tokens: self.max_new_tokens.map(|tokens| tokens as usize),
            center_crop: self.center_crop,
        }
    }

    /// The options that were given, for the header of a run; `None` without any.
    pub fn header(&self) -> Option<Value> {
        let options = self.options();
        (options != LoadOptions::default()).then(|| json!(options))
    }

    /// The options as they are typed, with a space before each.
    pub fn words(&self) -> String {
        let mut words = String::new();
        let mut add = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                words += &format!(" --{name} {value}");
            }
        };
        add("unnorm-key", self.unnorm_key.clone());
        let reasoning = (self.reasoning != ReasoningMode::Auto).then(|| self.reasoning.to_string());
        add("reasoning", reasoning);
        add("prompt", self.prompt.as_ref().map(|prompt| quoted(prompt)));
        add("max-new-tokens", self.max_new_tokens.map(|tokens| tokens.to_string()));
        if self.center_crop {
            words += " --center-crop";
        }
        words
    }
}

impl LoadedPolicy {
    /// The network that computes in this process, if there is one.
    pub fn network(&self) -> Option<&Arc<Vla>> {
        self.checkpoint.as_ref().or(self.backbone.as_ref())
    }

    /// The verifier in the policy's folder, if there is one.
    pub fn verifier_file(&self) -> Option<PathBuf> {
        self.folder.as_deref().and_then(verifier_beside)
    }

    /// The named verifier, or the one in the policy's folder if there is one.
    pub fn verifier(&self, named: Option<PathBuf>) -> Result<Option<Arc<Verifier>>> {
        let file = named.or_else(|| self.verifier_file());
        let load = |file: PathBuf| Verifier::load(&file, &self.policy.info().digest).map(Arc::new);
        file.map(load).transpose().map_err(wrong_usage)
    }
}

/// The verifier beside a checkpoint's weights, if there is one.
pub fn verifier_beside(folder: &Path) -> Option<PathBuf> {
    let file = folder.join(VERIFIER_FILE);
    file.is_file().then_some(file)
}

/// Parses a number of gigabytes.
fn gigabytes(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite() && *number > 0.0);
    number.ok_or_else(|| format!("expected a number of gigabytes above 0, got {text}"))
}

fn ensure_folder(folder: &Path, option: &str) -> Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    let name = folder.to_string_lossy();
    let download = match name.split('/').collect::<Vec<_>>().as_slice() {
        // A name on the Hub.
        [owner, name] if !owner.is_empty() && !owner.starts_with('.') => {
            format!("`hf download {owner}/{name} --local-dir {name}`, then {option} {name}")
        }
        _ => "`hf download OWNER/NAME --local-dir FOLDER`".to_owned(),
    };
    Err(WrongUsage(format!(
        "{option}: expected a checkpoint's folder, but {name} is not a folder; download a checkpoint from the \
         Hugging Face Hub with {download}"
    ))
    .into())
}

fn wrong_usage(error: anyhow::Error) -> anyhow::Error {
    WrongUsage(format!("{error:#}")).into()
}

/// A word for a POSIX shell.
fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', r"'\''"))
}
