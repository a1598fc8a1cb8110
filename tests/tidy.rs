//! Rules about the text of the repository that no compiler or linter checks.

use std::path::Path;

use crate::harness::{repository, succeed};

const FILE_LINES_MAX: usize = 400;
const FUNCTION_LINES_MAX: usize = 70;
/// Names without a meaning: the content of such a file belongs to the noun that it is about.
const EMPTY_NAMES: [&str; 6] = ["utils", "util", "common", "helpers", "manager", "base"];
/// Split, so that this file does not violate its own rule.
const UNFINISHED: [&str; 3] = [concat!("TO", "DO"), concat!("FIX", "ME"), concat!("XX", "X")];

/// One file that is, or is about to be, under version control.
pub struct SourceFile {
    /// Path relative to the repository, with `/`.
    pub path: String,
    /// `None` for a binary file.
    pub text: Option<String>,
}

/// Every file that git tracks or would add.
pub fn source_files() -> Vec<SourceFile> {
    let mut list = std::process::Command::new("git");
    // A container may run the tests as a user other than the owner of the files.
    list.args(["-c", "safe.directory=*", "ls-files", "-z", "--cached", "--others"]);
    let listed = succeed(list.arg("--exclude-standard").current_dir(repository()));
    let paths = listed.split('\0').filter(|path| repository().join(path).is_file());
    let read = |path: &str| std::fs::read(repository().join(path)).expect("a listed file is read");
    paths
        .map(|path| SourceFile { path: path.to_owned(), text: String::from_utf8(read(path)).ok() })
        .collect()
}

#[test]
fn every_file_is_tidy() {
    let files = source_files();
    assert!(files.len() > 50, "only {} files were found", files.len());
    let mut complaints = Vec::new();
    for file in &files {
        let stem = Path::new(&file.path).file_stem().unwrap_or_default().to_string_lossy();
        if EMPTY_NAMES.contains(&&*stem) {
            complaints.push(format!("{}: the name says nothing", file.path));
        }
        let Some(text) = &file.text else { continue };
        complaints.extend(complaints_about(&file.path, text));
        if file.path.ends_with(".rs") && !is_declared(&file.path, &files) {
            complaints.push(format!("{}: no module declares this file", file.path));
        }
    }
    assert!(complaints.is_empty(), "{} complaints:\n{}", complaints.len(), complaints.join("\n"));
}

#[test]
fn each_rule_detects_its_violation() {
    let long = |count: usize, line: &str| format!("{line}\n").repeat(count);
    for (path, text, complaint) in [
        ("a.rs", "//! Says what it is for.\n".to_owned(), None),
        ("a.rs", "use std::fs;\n".to_owned(), Some("a.rs:1: the first line")),
        ("a.py", "import os\n".to_owned(), Some("a.py:1: the first line")),
        ("a.toml", "[package]\n".to_owned(), Some("a.toml:1: the first line")),
        ("a.rs", "//! Good.\nlet a = 1; \n".to_owned(), Some("a.rs:2: a space at the end")),
        ("a.rs", "//! Good.\nfn".to_owned(), Some("a.rs: the last line does not end")),
        ("a.rs", format!("//! Good.\n// {} it.\n", UNFINISHED[0]), Some("a.rs:2: unfinished")),
        ("a.rs", long(401, "//! Good."), Some("a.rs: 401 lines")),
        (
            "a.rs",
            format!("//! Good.\nfn f() {{\n{}}}\n", long(69, "    g();")),
            Some("a.rs:2: a function of 71 lines"),
        ),
        ("a.rs", format!("//! Good.\nfn f() {{\n{}}}\n", long(68, "    g();")), None),
        (
            "a.py",
            format!("\"\"\"Good.\"\"\"\ndef f(\n) -> None:\n{}\nx = 1\n", long(69, "    g()")),
            Some("a.py:2: a function of 71 lines"),
        ),
    ] {
        let found = complaints_about(path, &text);
        match complaint {
            Some(start) => assert!(found[0].starts_with(start), "expected {start}, got {found:?}"),
            None => assert_eq!(found, Vec::<String>::new()),
        }
    }
}

fn complaints_about(path: &str, text: &str) -> Vec<String> {
    let mut complaints = Vec::new();
    if !starts_with_a_sentence(path, text) {
        complaints.push(format!("{path}:1: the first line does not say what the file is for"));
    }
    if !text.is_empty() && !text.ends_with('\n') {
        complaints.push(format!("{path}: the last line does not end"));
    }
    for (index, line) in text.lines().enumerate() {
        if line.ends_with([' ', '\t', '\r']) {
            complaints.push(format!("{path}:{}: a space at the end", index + 1));
        }
        if UNFINISHED.iter().any(|word| line.contains(word)) {
            complaints.push(format!("{path}:{}: unfinished", index + 1));
        }
    }
    if [".rs", ".py", ".js", ".css", ".html"].iter().any(|ending| path.ends_with(ending)) {
        let lines = text.lines().count();
        if lines > FILE_LINES_MAX {
            complaints.push(format!("{path}: {lines} lines, at most {FILE_LINES_MAX}"));
        }
        let functions = functions(path, text).into_iter();
        complaints.extend(functions.filter(|&(_, count)| count > FUNCTION_LINES_MAX).map(
            |(line, count)| {
                format!("{path}:{line}: a function of {count} lines, at most {FUNCTION_LINES_MAX}")
            },
        ));
    }
    complaints
}

/// Formats without comments and generated files have no first sentence.
fn starts_with_a_sentence(path: &str, text: &str) -> bool {
    let first = text.lines().find(|line| !line.starts_with("#!")).unwrap_or_default();
    let name = path.rsplit('/').next().unwrap_or_default();
    let opening: &[&str] = match name.rsplit('.').next().unwrap_or_default() {
        _ if name == "Cargo.lock" => return true,
        "rs" => &["//! "],
        "py" => &["\"\"\""],
        "toml" | "yml" | "lock" | "run" | "gitignore" | "dockerignore" | "Dockerfile" => &["# "],
        "xml" => &["<!-- "],
        "html" => &["<!doctype html>", "<!DOCTYPE html>", "<!-- "],
        "css" | "js" => &["// ", "/* ", "/** "],
        "md" => &["# "],
        _ => return true,
    };
    let what = opening.iter().find_map(|opening| first.strip_prefix(opening));
    what.is_some_and(|what| name.ends_with(".html") || what.len() > 3)
}

/// The first line and the length of every function, found by indentation: the formatters of both
/// languages indent a body more than its head and the lines after it.
fn functions(path: &str, text: &str) -> Vec<(usize, usize)> {
    let lines: Vec<&str> = text.lines().collect();
    let indent = |line: &str| line.len() - line.trim_start().len();
    let is_head = |line: &str| {
        let words = line.trim_start();
        if path.ends_with(".py") {
            return words.starts_with("def ") || words.starts_with("async def ");
        }
        let before = words.split('(').next().unwrap_or_default();
        let keyword = if path.ends_with(".rs") { "fn" } else { "function" };
        !words.starts_with("//") && before.split(' ').any(|word| word == keyword)
    };
    let mut found = Vec::new();
    for (start, line) in lines.iter().enumerate().filter(|(_, line)| is_head(line)) {
        let mut end = start;
        for (index, next) in lines.iter().enumerate().skip(start + 1) {
            if next.trim().is_empty() {
                continue;
            }
            let is_inside = indent(next) > indent(line);
            let closes = next.trim_start().starts_with([')', '}', ']']);
            if !(is_inside || closes && indent(next) == indent(line)) {
                break;
            }
            end = index;
        }
        found.push((start + 1, end - start + 1));
    }
    found
}

/// Cargo ignores a file that no `mod` names: it would never be compiled.
fn is_declared(path: &str, files: &[SourceFile]) -> bool {
    let (folder, name) = path.rsplit_once('/').unwrap_or(("", path));
    if ["lib.rs", "main.rs", "build.rs"].contains(&name) {
        return true;
    }
    // Cargo finds the root file of integration tests by itself.
    if folder.ends_with("/tests") && !folder.contains("/src/") {
        return true;
    }
    let (folder, module) = match name {
        "mod.rs" => folder.rsplit_once('/').unwrap_or(("", folder)),
        _ => (folder, name.trim_end_matches(".rs")),
    };
    let parents =
        ["mod.rs", "lib.rs", "main.rs"].map(|parent| format!("{folder}/{parent}")).to_vec();
    let parents = [parents, vec![format!("{folder}.rs")]].concat();
    files.iter().filter(|file| parents.contains(&file.path)).any(|file| {
        let text = file.text.as_deref().unwrap_or_default();
        text.lines().any(|line| line.trim_end_matches(';').ends_with(&format!("mod {module}")))
    })
}
