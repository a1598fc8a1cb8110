//! `rever report`: builds the page of a run, which opens from disk in any browser.

mod terms;
mod videos;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use clap::Args;
use decision::Reasoning;
use indicatif::{ProgressBar, ProgressStyle};

use super::episodes::{POLICY_OPTIONS, POLICY_SERVER};
use super::policy::PolicySource;
use super::recorded_policy::RecordedPolicy;
use crate::files::installation;
use evaluation::report::{self, EpisodeTerms, Readers, Report, ReportOptions, Speech};
use runtime::servers::{Host, LocalSource, Simulator};
use store::record::EpisodeRecord;
use store::run::{self, RunHeader};
use terms::ScoreTerms;
use vla::CompletionParser;

/// Default number of episodes whose steps are written: about 100 MB.
pub const EPISODES_MAX: usize = 1000;

/// Episodes whose candidates are compared with what the policy reads.
const EPISODES_CHECKED: usize = 3;

/// Servers that render videos: one per core of a small machine.
const SERVERS: usize = 2;

/// Build the page of a run: figures, tables, and every episode with its candidates
#[derive(Debug, Args)]
pub struct Arguments {
    /// The run's folder
    run: PathBuf,
    /// The report's folder [default: `report` in the run's folder]
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Verifier that scored the run, to show the terms of its scores
    /// [default: verifier.safetensors in the policy's folder]
    #[arg(long, value_name = "FILE")]
    verifier: Option<PathBuf>,
    /// Maximum number of episodes whose steps are shown; those with videos come first
    #[arg(long, default_value_t = EPISODES_MAX)]
    episodes_max: usize,
    /// Replay recorded episodes that have no video and save their videos in the run's folder; takes about as long as the
    /// simulator needs for their steps
    #[arg(long)]
    video: bool,
    /// Simulator for --video, which must be the one that the run was made with
    #[arg(long, value_enum, default_value_t, requires = "video")]
    simulator: Simulator,
    /// Python interpreter for the servers, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE", requires = "video")]
    python: Option<PathBuf>,
    /// Also write the results to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
    /// The policy that the run was made with; its tokenizer turns tokens into text
    #[command(flatten)]
    policy: PolicySource,
}

/// Builds the report and says where it is.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let out = arguments.out.unwrap_or_else(|| arguments.run.join("report"));
    if arguments.video {
        let local = LocalSource {
            count: SERVERS,
            simulator: arguments.simulator,
            python: arguments.python,
            installation: installation(host)?,
        };
        let made = videos::render(&arguments.run, local, arguments.episodes_max)?;
        println!("videos rendered: {made}");
    }
    let options =
        ReportOptions { run: &arguments.run, out: &out, episodes_max: arguments.episodes_max };
    let report = build_with(&options, &arguments.policy, arguments.verifier.as_deref(), host)?;
    if let Some(path) = &arguments.json {
        let text = serde_json::to_string_pretty(&report)?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    println!("{}", describe(&report));
    Ok(())
}

/// Builds the report of a run with the policy that made it, and the verifier in the policy's folder.
pub fn build(
    run: &Path,
    out: &Path,
    policy: &PolicySource,
    episodes_max: usize,
    host: &Host,
) -> Result<Report> {
    build_with(&ReportOptions { run, out, episodes_max }, policy, None, host)
}

fn build_with(
    options: &ReportOptions<'_>,
    policy: &PolicySource,
    verifier: Option<&Path>,
    host: &Host,
) -> Result<Report> {
    let header = run::read_header(options.run)?;
    let digest = header.versions["policy"].as_str();
    let digest = digest.context("run.json: expected the digest of a policy, got none")?;
    // A named checkpoint decodes the tokens of a policy server that sends its own.
    let is_named = policy.policy.is_some() && policy.address().is_none();
    if header.options.get(POLICY_SERVER).is_some() && !is_named {
        return build_of_server(options, header, verifier);
    }
    let parser = policy.parser_of_run(header.options.get(POLICY_OPTIONS), digest, host)?;
    ensure_parser_of(options.run, &parser)?;
    let parser = Arc::new(parser);
    let recorded = RecordedPolicy::Checkpoint(Arc::clone(&parser));
    let speak = |tokens: &[u32]| Speech {
        text: parser.text(tokens),
        reasoning: parser.parse(tokens).ok().map(|parsed| parsed.reasoning),
    };
    let terms = ScoreTerms::load(verifier, Some(&policy.folder(host)?), &recorded)?;
    let explain = |record: &_| terms.of(record);
    build_report(options, &Readers { speak: &speak, terms: terms.names(), explain: &explain })
}

/// For a policy server: its records hold the reasoning that it sent, and no text.
fn build_of_server(
    options: &ReportOptions<'_>,
    header: RunHeader,
    verifier: Option<&Path>,
) -> Result<Report> {
    let speak = |_: &[u32]| Speech { text: String::new(), reasoning: Some(Reasoning::default()) };
    let unknown = "The policy was a policy server; `rever report RUN --verifier FILE` shows the terms of scores.";
    let explain = |_: &_| Ok(EpisodeTerms::Unknown(unknown.to_owned()));
    if verifier.is_none() {
        let readers = Readers { speak: &speak, terms: Vec::new(), explain: &explain };
        return build_report(options, &readers);
    }
    let recorded = RecordedPolicy::server_of(&[header])?.context("expected a policy server")?;
    let terms = ScoreTerms::load(verifier, None, &recorded)?;
    let explain = |record: &_| terms.of(record);
    build_report(options, &Readers { speak: &speak, terms: terms.names(), explain: &explain })
}

fn build_report(options: &ReportOptions<'_>, readers: &Readers<'_>) -> Result<Report> {
    let bar = ProgressBar::no_length().with_prefix("report");
    bar.set_style(bar_style());
    let progress = |done: usize, total: usize| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    };
    let report = report::build(options, readers, &progress);
    bar.finish_and_clear();
    report
}

/// Whether the parser reads the candidates of a run as they were read when they were executed. The weights of the policy
/// are not needed: a report takes a second even for a checkpoint of 15 GB.
fn ensure_parser_of(run: &Path, parser: &CompletionParser) -> Result<()> {
    for id in run::recorded(run)?.iter().take(EPISODES_CHECKED) {
        let record = EpisodeRecord::read(&run::record_path(run, id))?;
        let candidates = record.decisions().flat_map(|decision| &decision.candidates);
        for candidate in candidates.filter(|candidate| !candidate.tokens.is_empty()) {
            let Some(recorded) = &candidate.actions else { continue };
            let read = parser.parse(&candidate.tokens);
            ensure!(
                read.as_ref().is_ok_and(|parsed| parsed.actions == *recorded),
                "policy: the run was made with {}, and this policy reads its candidates in another way (episode {id}); \
                 only the tokenizer and the options of the run's policy can decode its tokens (--policy)",
                parser.digest()
            );
        }
    }
    Ok(())
}

fn bar_style() -> ProgressStyle {
    let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len} {eta}");
    style.unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Where the report is and what is in it.
pub fn describe(report: &Report) -> String {
    let page = report.page.canonicalize().unwrap_or_else(|_| report.page.clone());
    format!(
        "report: file://{}\n        {} episodes, {} with steps, {} with video, {:.1} MB",
        page.display(),
        report.episodes,
        report.detailed,
        report.videos,
        report.bytes as f64 / 1e6
    )
}
