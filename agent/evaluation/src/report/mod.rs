//! The report of a run: a folder whose page opens from disk, with every number, video and candidate.
//!
//! ```text
//! index.html              tables and figures, readable without scripts
//! *.css, *.js             the viewer of episodes, and what figures and tables can be asked for
//! data/catalogue.js       one entry per episode, paired by initial layout
//! data/{id}.js            the steps of one episode, loaded when it is looked at
//! videos/{id}.mp4         the videos that the run has
//! ```
//!
//! A page opened from disk may neither fetch nor import, but it may add scripts: so data are scripts
//! that hand over one value each.

mod axis;
mod catalogue;
mod curve;
mod details;
mod escape;
mod figure;
mod forest;
mod glossary;
mod head;
mod intervals;
mod milestones;
mod page;
mod provenance;
#[cfg(test)]
pub(crate) mod sample;
mod scores;
mod sections;
mod strategies;
mod tables;
#[cfg(test)]
mod tests;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::Serialize;

use crate::results::{Results, tasks_in_order};
use decision::Reasoning;
use store::record::EpisodeRecord;
use store::run;

use catalogue::Catalogue;
use details::Details;
use milestones::Milestones;
use scores::Scored;

/// What a report is made of and where it goes.
pub struct ReportOptions<'a> {
    /// The run's folder.
    pub run: &'a Path,
    /// The report's folder; files of an older report in it are replaced.
    pub out: &'a Path,
    /// Episodes whose steps are written; about 0.1 MB each.
    pub episodes_max: usize,
}

/// What a completion says, rebuilt from its tokens.
pub struct Speech {
    /// The whole text.
    pub text: String,
    /// Its parts; none when it does not parse.
    pub reasoning: Option<Reasoning>,
}

/// What the scores of an episode are made of.
pub enum EpisodeTerms {
    /// One entry per step, none without a decision; in it one row for each well-formed candidate. A row has one number for
    /// each term: what it adds to the candidate's advantage over its siblings, as a probability.
    Known(Vec<Option<Vec<Vec<f32>>>>),
    /// Why there are none, as a sentence.
    Unknown(String),
}

/// What turns records into something that people can read.
pub struct Readers<'a> {
    /// The text of tokens.
    pub speak: &'a dyn Fn(&[u32]) -> Speech,
    /// What each term is.
    pub terms: Vec<String>,
    /// The terms of an episode's scores.
    pub explain: &'a dyn Fn(&EpisodeRecord) -> anyhow::Result<EpisodeTerms>,
}

/// What was written.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The page to open.
    pub page: PathBuf,
    /// Episodes listed.
    pub episodes: usize,
    /// Episodes with their steps.
    pub detailed: usize,
    /// Episodes with a video.
    pub videos: usize,
    /// Bytes of all files; linked videos take no second place on the disk.
    pub bytes: u64,
}

/// Builds the report; `progress` hears how many episodes are done, of how many.
pub fn build(
    options: &ReportOptions<'_>,
    readers: &Readers<'_>,
    progress: &dyn Fn(usize, usize),
) -> anyhow::Result<Report> {
    let header = run::read_header(options.run)?;
    let summaries = run::summaries(options.run)?;
    let name = options.run.display();
    ensure!(!summaries.is_empty(), "the run {name} has no finished episode to report");
    let has_video = |id: &str| run::video_path(options.run, id).is_file();
    let faults = run::faults(options.run)?;
    let results = Results::new(&summaries, &faults, &tasks_in_order(&header.options))?;
    let mut catalogue = Catalogue::new(
        &header.run,
        &summaries,
        &faults,
        &results,
        has_video,
        options.episodes_max,
    )?;
    catalogue.terms.clone_from(&readers.terms);
    let mut folder = Folder::new(options.out)?;
    let mut scored = Vec::new();
    let mut simulators = BTreeSet::new();
    let (total, mut detailed, mut videos) = (summaries.len(), 0, 0);
    for (done, entry) in catalogue.recorded_mut().enumerate() {
        progress(done, total);
        let record = EpisodeRecord::read(&run::record_path(options.run, &entry.id))?;
        entry.milestones = Milestones::of(&record);
        if results.counted.contains(&entry.id) {
            scored.extend(chosen_scores(&record)?);
        }
        simulators.insert(record.versions.simulator.clone());
        if entry.detail {
            let details = Details::new(&record, readers)?;
            folder.write_script(&entry.id, "reverEpisode(", &details, ");\n")?;
            detailed += 1;
        }
        if entry.video {
            folder.take_video(&run::video_path(options.run, &entry.id), &entry.id)?;
            videos += 1;
        }
    }
    folder.write_script("catalogue", "window.reverCatalogue = ", &catalogue, ";\n")?;
    for (name, text) in page::FILES {
        folder.write(name, text.as_bytes())?;
    }
    folder.write(
        "index.html",
        sections::page(&header, &simulators, &results, &scored).html()?.as_bytes(),
    )?;
    folder.sweep()?;
    progress(total, total);
    Ok(Report {
        page: options.out.join("index.html"),
        episodes: total,
        detailed,
        videos,
        bytes: folder.bytes,
    })
}

/// The scores of executed candidates, with what became of their episode.
fn chosen_scores(record: &EpisodeRecord) -> anyhow::Result<Vec<Scored>> {
    let is_selected = record.identity.setting()?.strategy.compares_candidates();
    let chosen = record.decisions().filter_map(|decision| {
        let score = decision.candidates.get(decision.chosen? as usize)?.score?;
        Some(Scored { score, is_success: record.statistics.is_success, is_selected })
    });
    Ok(chosen.collect())
}

/// The report's folder while it is written.
struct Folder<'a> {
    path: &'a Path,
    written: BTreeSet<PathBuf>,
    bytes: u64,
}

impl<'a> Folder<'a> {
    fn new(path: &'a Path) -> anyhow::Result<Self> {
        for folder in ["data", "videos"] {
            let folder = path.join(folder);
            std::fs::create_dir_all(&folder).with_context(|| {
                format!("cannot make {}; choose another folder (--out)", folder.display())
            })?;
        }
        Ok(Self { path, written: BTreeSet::new(), bytes: 0 })
    }

    fn write(&mut self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        let path = self.path.join(name);
        std::fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
        self.bytes += bytes.len() as u64;
        self.written.insert(path);
        Ok(())
    }

    fn write_script(
        &mut self,
        name: &str,
        before: &str,
        value: &impl Serialize,
        after: &str,
    ) -> anyhow::Result<()> {
        let text = format!("{before}{}{after}", escape::script(value)?);
        self.write(&format!("data/{name}.js"), text.as_bytes())
    }

    /// Links the video where the file system can, so that a report costs no second copy.
    fn take_video(&mut self, from: &Path, id: &str) -> anyhow::Result<()> {
        let to = self.path.join("videos").join(format!("{id}.mp4"));
        if to.exists() {
            std::fs::remove_file(&to)
                .with_context(|| format!("cannot replace {}", to.display()))?;
        }
        self.bytes += from.metadata().map_or(0, |metadata| metadata.len());
        if std::fs::hard_link(from, &to).is_err() {
            std::fs::copy(from, &to).with_context(|| format!("cannot copy {}", from.display()))?;
        }
        self.written.insert(to);
        Ok(())
    }

    /// Removes what an older report left in the two folders that hold nothing else.
    fn sweep(&self) -> anyhow::Result<()> {
        for (folder, extension) in [("data", "js"), ("videos", "mp4")] {
            for entry in std::fs::read_dir(self.path.join(folder))? {
                let path = entry?.path();
                let is_ours = path.extension().is_some_and(|found| found == extension);
                if is_ours && !self.written.contains(&path) {
                    std::fs::remove_file(&path)
                        .with_context(|| format!("cannot remove {}", path.display()))?;
                }
            }
        }
        Ok(())
    }
}
