//! The README's tree names every file and folder of the top two levels, and nothing that is gone.

use std::collections::BTreeSet;

use crate::harness::repository;
use crate::tidy::source_files;

/// Settings of tools that a reader of the tree does not look for.
const NOT_LISTED: [&str; 3] = [".gitignore", ".dockerignore", ".gitattributes"];

#[test]
fn the_tree_names_what_is_there() {
    let readme =
        std::fs::read_to_string(repository().join("README.md")).expect("there is a README");
    let block =
        readme.split("```").find(|block| block.lines().any(|line| line.starts_with("agent/")));
    let listed = paths_of(block.expect("the README shows the tree in a fenced block"));
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
    assert!(missing.is_empty(), "the README's tree does not name {missing:?}");
    let gone: Vec<_> =
        listed.iter().filter(|path| !repository().join(path.as_str()).exists()).collect();
    assert!(gone.is_empty(), "the README's tree names what is not there: {gone:?}");
}

#[test]
fn a_tree_is_read_by_its_indentation() {
    let tree = "agent/   the agent\n  src/    code\n    lib.rs  the map\n  Cargo.toml\nREADME.md\n";
    let expected = ["README.md", "agent/", "agent/Cargo.toml", "agent/src/", "agent/src/lib.rs"];
    assert_eq!(paths_of(tree).iter().map(String::as_str).collect::<Vec<_>>(), expected);
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
