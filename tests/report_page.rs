//! The page of a run in a real browser: `report_page.py` drives Chromium through it.

use std::collections::BTreeMap;
use std::fs::Metadata;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::evaluation::Evaluation;
use crate::harness::{
    ensure_browser, entries_below, python, repository, rever, run, succeed, text,
};

/// The shipped verifier wins some of these pairs, which are the same in every run.
const ARGUMENTS: [&str; 8] = [
    "--strategies=sample,verifier",
    "--candidates=5",
    "--episodes=2",
    "--layouts=random",
    "--tasks=widowx_carrot_on_plate,widowx_stack_cube",
    "--seed=0",
    "--sessions=8",
    "--video",
];

#[test]
fn the_page_of_a_run_works_in_a_browser() {
    ensure_browser();
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("report-page");
    if folder.exists() {
        std::fs::remove_dir_all(&folder).expect("the last run's files can be removed");
    }
    std::fs::create_dir_all(&folder).expect("a folder can be made");
    let evaluation = Evaluation::new(&folder, &ARGUMENTS);
    evaluation.finish();
    let report = folder.join("report");
    let before = files(&evaluation.run_folder());
    succeed(rever().arg("report").arg(evaluation.run_folder()).arg("--out").arg(&report));
    assert_eq!(files(&evaluation.run_folder()), before, "a run may be read-only for its reader");

    // One video is made again from its record, in which the simulator has to do the same once more.
    let videos = evaluation.run_folder().join("videos");
    let video = videos.read_dir().expect("videos").next().expect("a video").expect("a file").path();
    std::fs::remove_file(&video).expect("it can be removed");
    let mut again = rever();
    again.arg("report").arg(evaluation.run_folder()).arg("--out").arg(&report);
    let said = succeed(again.args(["--video", "--python"]).arg(&python().python));
    assert!(said.contains("videos rendered: 1") && video.is_file(), "{said}");

    // Left for a look afterwards.
    let screenshots = folder.join("screenshots");
    let mut browser = python().command();
    browser.arg(repository().join("tests/report_page.py")).arg(&report);
    let output = run(browser.arg("--screenshots").arg(&screenshots));
    let said = text(&output);
    assert!(output.status.success(), "{said}");
    // Written past the capture of the test runner, so that every run shows how many checks passed.
    let checks = said.lines().filter(|line| line.starts_with("ok ")).count();
    writeln!(std::io::stderr(), "report page: {checks} checks, {}", screenshots.display())
        .expect("standard error is open");
}

/// Size and modification time of everything in a folder.
fn files(folder: &Path) -> BTreeMap<PathBuf, (u64, SystemTime)> {
    let times = |data: Metadata| (data.len(), data.modified().expect("a time"));
    entries_below(folder).map(|(path, data)| (path, times(data))).collect()
}
