//! The subcommands: each file holds the arguments of one subcommand and the function that runs it.

mod bench;
mod cache;
mod collect;
mod completions;
mod conformance;
mod demo;
mod digest;
mod doctor;
mod episodes;
mod evaluate;
mod list;
mod loading;
mod names;
mod policy;
mod policy_server;
mod recorded_policy;
mod report;
mod selection;
mod serve_policy;
mod show;
mod train;

use std::fmt;
use std::io::IsTerminal;
use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Parser, Subcommand};
use evaluation::results::Results;
use evaluation::table::{self, COLUMNS_DEFAULT};
use runtime::servers::Host;
use tracing_subscriber::EnvFilter;

/// Evaluate reasoning VLA policies: sample several candidates per step, verify them, execute the best one
#[derive(Debug, Parser)]
#[command(
    name = "rever",
    version = concat!(env!("CARGO_PKG_VERSION"), " (", env!("REVER_COMMIT"), ", ", env!("REVER_BUILD_DATE"), ")"),
    max_term_width = 100,
    subcommand_help_heading = "Commands",
    after_help = "\
Start with `rever demo`. Every run is a folder. After Ctrl-C, a crash or kill -9, rerun the same command to resume it.

Exit status: 0 complete, 1 fault or incomplete run, 2 wrong usage, 130 stopped by Ctrl-C.
Environment: REVER_LOG  log filter, such as debug or runtime=trace [default: warn]
             REVER_HOME folder for the program's files and Python environment [default: ~/.local/share/rever]
             NO_COLOR   no colours",
)]
pub struct Program {
    #[command(flatten)]
    verbosity: Verbosity,
    #[command(subcommand)]
    command: Command,
}

/// How much to print.
#[derive(Debug, Clone, Copy, Args)]
struct Verbosity {
    /// Show all tables, and log more; -vv logs debug messages
    #[arg(short, long, global = true, action = clap::ArgAction::Count, help_heading = "Output")]
    verbose: u8,
    /// Show results and errors only
    #[arg(short, long, global = true, conflicts_with = "verbose", help_heading = "Output")]
    quiet: bool,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Arguments),
    Evaluate(evaluate::Arguments),
    Collect(collect::Arguments),
    Train(train::Arguments),
    Report(report::Arguments),
    Show(show::Arguments),
    List(list::Arguments),
    Doctor(doctor::Arguments),
    ServePolicy(serve_policy::Arguments),
    Bench(bench::Arguments),
    Conformance(conformance::Arguments),
    Digest(digest::Arguments),
    Completions(completions::CompletionsArguments),
    Man(completions::ManArguments),
}

/// How much a command prints.
#[derive(Debug, Clone, Copy, Default)]
pub struct Output {
    /// Print all tables.
    pub is_verbose: bool,
    /// Print results and errors only.
    pub is_quiet: bool,
}

impl Output {
    /// The results of a run as text: the answer, and with `-v` all tables.
    pub fn results(self, results: &Results) -> String {
        let columns = terminal_size::terminal_size().map(|(width, _)| usize::from(width.0));
        let answer = table::answer(results, columns.unwrap_or(COLUMNS_DEFAULT));
        if self.is_verbose {
            format!("{answer}\n{}", table::details::text(results))
        } else {
            answer
        }
    }
}

impl Program {
    /// Runs the chosen subcommand.
    pub fn run(self, host: &Host) -> Result<()> {
        let Verbosity { verbose, quiet: is_quiet } = self.verbosity;
        let output = Output { is_verbose: verbose > 0, is_quiet };
        match self.command {
            Command::Demo(arguments) => demo::run(arguments, host, output),
            Command::Evaluate(arguments) => evaluate::run(arguments, host, output),
            Command::Collect(arguments) => collect::run(arguments, host, output),
            Command::Train(arguments) => train::run(arguments, host),
            Command::Report(arguments) => report::run(arguments, host),
            Command::Show(arguments) => show::run(&arguments, output),
            Command::List(arguments) => list::run(arguments, host),
            Command::Doctor(arguments) => doctor::run(arguments, host),
            Command::ServePolicy(arguments) => serve_policy::run(arguments, host, output),
            Command::Bench(arguments) => bench::run(arguments, host),
            Command::Conformance(arguments) => conformance::run(arguments, host),
            Command::Digest(arguments) => digest::run(arguments),
            Command::Completions(arguments) => completions::run(&arguments),
            Command::Man(arguments) => completions::write_pages(&arguments),
        }
    }

    /// Sends the log to standard error. `filter` has the syntax of `tracing` and overrides -v and -q.
    pub fn start_log(&self, filter: Option<&str>, has_colours: bool) {
        // Zenoh's log is off: the errors that matter are returned as errors.
        let default = match self.verbosity {
            Verbosity { quiet: true, .. } => "error,zenoh=off",
            Verbosity { verbose: 0, .. } => "warn,zenoh=off",
            Verbosity { verbose: 1, .. } => "info,zenoh=off",
            Verbosity { .. } => "debug,zenoh=warn",
        };
        tracing_subscriber::fmt()
            .with_env_filter(EnvFilter::new(filter.unwrap_or(default)))
            .with_ansi(has_colours && std::io::stderr().is_terminal())
            .with_writer(std::io::stderr)
            .init();
    }
}

/// The command line asks for something that does not exist. Detected before anything is started.
#[derive(Debug)]
pub struct WrongUsage(pub String);

impl fmt::Display for WrongUsage {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

impl std::error::Error for WrongUsage {}

/// Parses the path of an output file. A file that cannot be written is an error now, not at the end of the command.
pub fn output_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    store::check_writable(&path).map_err(|error| format!("{error:#}"))?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_of_all_commands_are_consistent() {
        <Program as clap::CommandFactory>::command().debug_assert();
    }

    #[test]
    fn a_misspelt_strategy_is_refused_with_a_suggestion() {
        let parse = |value| Program::try_parse_from(["rever", "evaluate", "--strategies", value]);
        let error = parse("sample,verifer").expect_err("there is none");
        assert_eq!(error.exit_code(), 2);
        let text = error.to_string();
        assert!(text.contains("'verifer'") && text.contains("'verifier'"), "{text}");
        assert!(parse("sample, verifier").is_ok(), "a space is no part of a name");
    }

    #[test]
    fn numbers_of_episodes_that_make_no_sense_are_wrong_usage() {
        for (command, value) in [("evaluate", "0"), ("collect", "-3"), ("demo", "0")] {
            let words = ["rever", command, "--episodes", value];
            let error = Program::try_parse_from(words).expect_err("no episode");
            assert!(error.to_string().contains(&format!("'{value}'")), "{error}");
        }
    }

    #[test]
    fn a_file_that_cannot_be_written_is_wrong_usage_of_every_command_that_writes_one() {
        let commands: [&[&str]; 9] = [
            &["demo"],
            &["evaluate"],
            &["collect"],
            &["train"],
            &["report", "run"],
            &["doctor"],
            &["conformance"],
            &["bench", "decision"],
            &["bench", "simulators"],
        ];
        for command in commands {
            let words = ["rever"].iter().chain(command).chain(&["--json", "/proc/none/x.json"]);
            let error = Program::try_parse_from(words).expect_err("it cannot be written");
            assert_eq!(error.exit_code(), 2, "{command:?}: {error}");
            let text = error.to_string();
            assert!(text.contains("cannot write /proc/none/x.json"), "{command:?}: {text}");
        }
    }
}
