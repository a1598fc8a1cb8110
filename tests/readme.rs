//! The documents are true: `rever` accepts their commands, README's short ones run, links lead somewhere, the tree is complete.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use tempfile::TempDir;

use crate::harness::{python, repository, rever, run, succeed, text};
use crate::server::free_endpoint;
use crate::tidy::source_files;

/// Where the tree is.
const CONTRIBUTING: &str = "agent/docs/CONTRIBUTING.md";
/// Documents with commands and links, beside those of `agent/docs`. The log is of its days: old commands stay in it.
const DOCUMENTS: [&str; 7] = [
    "README.md",
    "agent/models/bridge-flow/README.md",
    "agent/models/bridge-small/README.md",
    "agent/remote-policy/README.md",
    "env-server/README.md",
    "env-server/simulator/README.md",
    "protocol/README.md",
];
/// Settings of tools that a reader of the tree does not look for.
const NOT_LISTED: [&str; 3] = [".gitignore", ".dockerignore", ".gitattributes"];
/// Commands that this test does not run: they compile, install, download or need another machine. An entry that ends with a
/// space is the beginning of a command.
const NOT_RUN: [&str; 26] = [
    "(cd env-server && python -m pytest)",
    ".venv/lerobot/bin/pip install ",
    ".venv/lerobot/bin/python agent/training/random_smolvla.py ",
    ".venv/lerobot/bin/python agent/training/serve_lerobot.py ",
    ".venv/openvla/bin/pip install ",
    ".venv/openvla/bin/python agent/training/reference.py ",
    ".venv/serve/bin/pip install ",
    ".venv/serve/bin/python agent/training/serve.py ",
    "REVER_FUZZ_FRAMES=100000 cargo test ",
    "cargo install --path agent/cli",
    "cargo install --path agent/cli --features cuda",
    "cargo test --release --workspace",
    "docker compose up --build --exit-code-from agent",
    "hf download ",
    "maturin build --release --locked --manifest-path agent/cli/Cargo.toml",
    "pip install './env-server[gymnasium]'",
    "pip install './env-server[robosuite]'",
    "pip install ./env-server",
    "pip install ./env-server vla-eval==0.8.0",
    "pip install ./env-server -c env-server/requirements-minimum.txt pytest pillow",
    "pip install rever-*.whl",
    "python -c ",
    "sleep ",
    "srun python -m rever_env serve ",
    "vla-eval run ",
    "zenohd ",
];
/// Commands that documents name as missing; who adds one describes it.
const NOT_YET: [&str; 4] = ["compare", "export", "paper", "status"];
/// Commands of README that are run in this order, with what makes them small.
const RUN: [(&str, &str); 6] = [
    ("rever list strategies", ""),
    ("rever doctor", "--python=$PYTHON"),
    ("rever doctor --policy my-policy", "--python=$PYTHON"),
    ("rever demo", "--episodes=1 --out=runs/mine --python=$PYTHON"),
    (
        "rever evaluate --policy my-policy --strategies greedy,sample",
        "--episodes=1 --tasks=widowx_spoon_on_towel --servers=1 --python=$PYTHON",
    ),
    ("rever report runs/mine --policy my-policy", ""),
];

/// A folder to run a document's commands in, with `rever`, `python`, and a policy called `my-policy`.
struct Workplace {
    folder: TempDir,
}

impl Workplace {
    fn new() -> Workplace {
        let folder = tempfile::tempdir().expect("a folder");
        let workplace = Workplace { folder };
        std::fs::create_dir(workplace.path("bin")).expect("a folder can be made");
        let link = |target: &Path, name: &str| {
            symlink(target, workplace.path(name)).expect("a link can be made");
        };
        link(Path::new(rever().get_program()), "bin/rever");
        link(&repository().join("agent/models/bridge-small"), "my-policy");
        // `python -m rever_env ARGUMENTS` up to the parsed command line; argparse would let --help hide what is wrong.
        workplace.script(
            "python",
            "test \"$1 $2\" = '-m rever_env' || exit 2; shift 2
             exec $PYTHON -c 'import sys; from rever_env.__main__ import _parser; _parser().parse_args()' \"$@\"",
        );
        workplace.script("scontrol", "echo node1; echo node2");
        workplace
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn script(&self, name: &str, text: &str) {
        let path = self.path("bin").join(name);
        std::fs::write(&path, format!("#!/bin/sh\n{text}\n")).expect("a script can be written");
        let mode = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(path, mode).expect("it can be run");
    }

    /// Runs a line of a document as a shell would.
    fn shell(&self, line: &str) -> Output {
        let environment = python();
        let inherited = std::env::vars_os().find(|(name, _)| name == "PATH");
        let (_, path) = inherited.expect("there is a PATH");
        let mut shell = Command::new("sh");
        shell.env_clear().envs(&environment.variables).env("PYTHON", &environment.python);
        shell.env("PATH", format!("{}:{}", self.path("bin").display(), path.to_string_lossy()));
        shell.env("HOME", self.path("home")).current_dir(self.folder.path());
        run(shell.args(["-c", line]).stdin(Stdio::null()))
    }

    /// Why the program does not accept the command; it is not carried out.
    fn objection(&self, command: &str) -> Option<String> {
        // clap reads the words in order: what stands before --help must be known, and its values valid.
        let ending = if command.starts_with("rever ") { " --help" } else { "" };
        let output = self.shell(&format!("{command}{ending}"));
        (!output.status.success()).then(|| format!("{command}: {}", text(&output)))
    }
}

#[test]
fn commands_of_the_documents_are_accepted() {
    let workplace = Workplace::new();
    let mut complaints = Vec::new();
    let mut checked = 0;
    for path in documents() {
        let document = read(&path);
        let commands = fenced(&document, "sh").into_iter().flat_map(commands_of);
        for command in commands.chain(quoted(&document)) {
            if NOT_RUN.iter().any(|known| is_known(&command, known)) {
                continue;
            }
            let command = command.replace("cargo run --release -- ", "rever ");
            let objection = workplace.objection(&command);
            let is_missing = NOT_YET.iter().any(|name| command == format!("rever {name}"));
            checked += 1;
            match objection {
                Some(objection) if !is_missing => complaints.push(format!("{path}: {objection}")),
                None if is_missing => complaints.push(format!("{path}: {command} is there")),
                _ => {}
            }
        }
    }
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
    assert!(checked > 50, "only {checked} commands were found");
}

#[test]
fn a_command_that_is_wrong_is_noticed() {
    let workplace = Workplace::new();
    for (command, objection) in [
        ("rever evaluate --layouts random --episodes 100 --out runs/mine", None),
        ("rever evaluate --placements random", Some("--placements")),
        ("rever evaluate --strategies greedy,verifer", Some("verifer")),
        ("rever evaluate --episodes many", Some("many")),
        ("rever report runs/a runs/b", Some("runs/b")),
        ("rever evaluat", Some("evaluat")),
        ("python -m rever_env serve --listen tcp/127.0.0.1:7447", None),
        ("python -m rever_env serve --listn tcp/127.0.0.1:7447", Some("--listn")),
        ("reverse", Some("reverse")),
    ] {
        let found = workplace.objection(command);
        match objection {
            None => assert_eq!(found, None),
            Some(word) => {
                let found = found.unwrap_or_else(|| panic!("{command} was accepted"));
                assert!(found.contains(word), "{found}");
            }
        }
    }
}

#[test]
fn short_commands_of_the_readme_run() {
    let workplace = Workplace::new();
    let written = commands_of_readme();
    for (command, smaller) in RUN {
        assert!(written.iter().any(|line| line == command), "README has no longer: {command}");
        let output = workplace.shell(&format!("{command} {smaller}"));
        assert!(output.status.success(), "{command}: {}\n{}", output.status, text(&output));
    }
    assert!(workplace.path("runs/mine/report/index.html").is_file());
}

#[test]
fn the_first_example_of_env_server_runs() {
    let readme = read("env-server/README.md");
    let examples = fenced(&readme, "python");
    let said = succeed(python().command().args(["-c", examples[0]]));
    assert!(said.ends_with("\nsuccess\n") || said.ends_with("\nfailure\n"), "{said:?}");
}

#[test]
fn readmes_servers_are_found() {
    let workplace = Workplace::new();
    let commands = commands_of_readme();
    let command = |start: &str| -> &str {
        let found = commands.iter().find(|line| line.starts_with(start));
        found.unwrap_or_else(|| panic!("README has no longer: {start}"))
    };
    let endpoint = free_endpoint();
    let serve = command("python -m rever_env serve").replace("tcp/0.0.0.0:7447", &endpoint);
    let mut words = serve.split_whitespace();
    assert_eq!(words.next(), Some("python"));
    let mut server = python().command();
    server.args(words).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut server = Ended(server.spawn().expect("the server starts"));
    let mut line = String::new();
    let stdout = server.0.stdout.take().expect("its standard output is piped");
    BufReader::new(stdout).read_line(&mut line).expect("its standard output is text");
    assert!(line.starts_with("ready"), "{line:?}");
    // One machine of the three, and a doctor in place of an evaluation.
    let evaluate = command("rever evaluate --connect A:7447,B:7447,C:7447 ");
    let servers = evaluate.split_whitespace().nth(3).and_then(|servers| servers.split(',').next());
    let address = servers.expect("a server").replace("A:7447", endpoint.trim_start_matches("tcp/"));
    let output = workplace.shell(&format!("rever doctor --connect {address} --python=$PYTHON"));
    assert!(output.status.success(), "{}", text(&output));
}

/// A process that is killed with its test.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        // It may be dead already, which is what matters here.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn what_is_not_run_is_what_is_done_elsewhere() {
    let written = documents().iter().map(|path| read(path)).collect::<String>();
    for known in NOT_RUN {
        assert!(written.contains(known), "no document has: {known}");
    }
    assert!(read(".ci/run").contains("cargo test --release --workspace"));
    assert!(read("agent/cli/Cargo.toml").contains("cuda = ["));
}

#[test]
fn links_lead_somewhere() {
    let mut complaints = Vec::new();
    for path in documents() {
        let document = read(&path);
        let folder = repository().join(&path).parent().expect("a document is a file").to_owned();
        for link in document.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let (file, heading) = link.split_once('#').unwrap_or((link, ""));
            if file.starts_with("https://") {
                continue;
            }
            let target = if file.is_empty() { repository().join(&path) } else { folder.join(file) };
            if !target.exists() {
                complaints.push(format!("{path}: {link} is not there"));
            } else if !heading.is_empty() {
                let text = std::fs::read_to_string(&target).expect("a document is text");
                if !text.lines().any(|line| anchor(line).as_deref() == Some(heading)) {
                    complaints.push(format!("{path}: {link}: there is no such heading"));
                }
            }
        }
    }
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
}

#[test]
fn the_tree_names_what_is_there() {
    let document = read(CONTRIBUTING);
    let blocks = fenced(&document, "text");
    let block = blocks.iter().find(|block| block.lines().any(|line| line.starts_with("agent/")));
    let listed = paths_of(block.expect("the tree is in a fenced block"));
    let mut there = BTreeSet::new();
    for file in source_files() {
        let parts: Vec<&str> = file.path.split('/').collect();
        for depth in 1..=parts.len().min(2) {
            let ending = if depth < parts.len() { "/" } else { "" };
            there.insert(format!("{}{ending}", parts[..depth].join("/")));
        }
    }
    there.retain(|path| !NOT_LISTED.contains(&path.rsplit('/').next().unwrap_or_default()));
    let missing: Vec<_> = there.difference(&listed).collect();
    assert!(missing.is_empty(), "the tree of {CONTRIBUTING} does not name {missing:?}");
    let gone: Vec<_> =
        listed.iter().filter(|path| !repository().join(path.as_str()).exists()).collect();
    assert!(gone.is_empty(), "the tree of {CONTRIBUTING} names what is not there: {gone:?}");
}

#[test]
fn a_tree_is_read_by_its_indentation() {
    let tree = "agent/   the agent\n  src/    code\n    lib.rs  the map\n  Cargo.toml\nREADME.md\n";
    let expected = ["README.md", "agent/", "agent/Cargo.toml", "agent/src/", "agent/src/lib.rs"];
    assert_eq!(paths_of(tree).iter().map(String::as_str).collect::<Vec<_>>(), expected);
}

#[test]
fn a_document_is_read_as_it_is_shown() {
    let document = "Use `rever\ndemo`, `x`, `rever a|b`.\n```sh\nrever demo \\\n  --seed 1  # small\n\n# none\na && b\n```\n## A b, c?\n";
    assert_eq!(quoted(document), ["rever demo"]);
    let blocks = fenced(document, "sh");
    let commands: Vec<String> = blocks.into_iter().flat_map(commands_of).collect();
    assert_eq!(commands, ["rever demo --seed 1", "a", "b"]);
    assert_eq!(anchor("## A b, c?").as_deref(), Some("a-b-c"));
    assert_eq!(fenced(document, "python"), Vec::<&str>::new());
}

fn is_known(command: &str, known: &str) -> bool {
    if known.ends_with(' ') { command.starts_with(known) } else { command == known }
}

fn documents() -> Vec<String> {
    let folder = repository().join("agent/docs").read_dir().expect("there are documents");
    let names = folder.map(|entry| entry.expect("a file").file_name().into_string());
    let names =
        names.map(|name| name.expect("a name in UTF-8")).filter(|name| name.ends_with(".md"));
    let mut paths: Vec<String> = names.map(|name| format!("agent/docs/{name}")).collect();
    paths.sort();
    DOCUMENTS.map(str::to_owned).into_iter().chain(paths).collect()
}

/// In blocks and in running text.
fn commands_of_readme() -> Vec<String> {
    let readme = read("README.md");
    fenced(&readme, "sh").into_iter().flat_map(commands_of).chain(quoted(&readme)).collect()
}

fn read(path: &str) -> String {
    std::fs::read_to_string(repository().join(path))
        .unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// The fenced blocks of one language.
fn fenced<'a>(document: &'a str, language: &str) -> Vec<&'a str> {
    let blocks = document.split("```").skip(1).step_by(2);
    blocks.filter_map(|block| block.strip_prefix(language)?.strip_prefix('\n')).collect()
}

/// The commands of a block: comments go, and so do the ends of lines within a command.
fn commands_of(block: &str) -> Vec<String> {
    let block = block.replace("\\\n", " ");
    let lines = block.lines().map(|line| line.split(" #").next().unwrap_or_default());
    let lines = lines.filter(|line| !line.starts_with('#'));
    let split = |line: &str| -> Vec<String> {
        let is_one = line.starts_with('(');
        if is_one { vec![line.to_owned()] } else { line.split("&&").map(str::to_owned).collect() }
    };
    let words = |part: String| part.split_whitespace().collect::<Vec<_>>().join(" ");
    lines.flat_map(split).map(words).filter(|command| !command.is_empty()).collect()
}

/// Commands of `rever` in running text; those that leave something open are not commands.
fn quoted(document: &str) -> Vec<String> {
    let text: String = document.split("```").step_by(2).collect();
    let spans = text.split('`').skip(1).step_by(2);
    let spans = spans.map(|span| span.split_whitespace().collect::<Vec<_>>().join(" "));
    let is_command = |span: &String| {
        span.starts_with("rever ") && !span.contains(['|', '…']) && !span.contains("...")
    };
    spans.filter(is_command).collect()
}

/// What a link to this heading is called; none of another line.
fn anchor(line: &str) -> Option<String> {
    let heading =
        line.trim_start_matches('#').strip_prefix(' ').filter(|_| line.starts_with('#'))?;
    let kept = heading.chars().filter(|letter| letter.is_alphanumeric() || " -_".contains(*letter));
    Some(kept.collect::<String>().to_lowercase().replace(' ', "-"))
}

/// Each line is an indented name, then what it is for. A folder's name ends with `/`.
fn paths_of(tree: &str) -> BTreeSet<String> {
    let mut folders: Vec<(usize, String)> = Vec::new();
    let mut paths = BTreeSet::new();
    for line in tree.lines() {
        let name_and_purpose = line.trim_start_matches([' ', '│', '├', '└', '─']);
        let indent = line.chars().count() - name_and_purpose.chars().count();
        let Some(name) = name_and_purpose.split_whitespace().next() else { continue };
        folders.retain(|(depth, _)| *depth < indent);
        let folder = folders.last().map(|(_, path)| path.as_str()).unwrap_or_default();
        let path = format!("{folder}{name}");
        if name.ends_with('/') {
            folders.push((indent, path.clone()));
        }
        paths.insert(path);
    }
    paths
}
