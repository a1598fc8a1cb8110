//! Encodes the frames of running episodes and keeps the video of those that end well.

use std::collections::HashMap;
use std::path::PathBuf;

use anyhow::{Context, Result};
use protocol::Image;
use store::record::write_whole;
use store::run::video_path;
use store::video::Video;

use super::{Event, EventSink};

/// Writes videos into a run's folder. It comes before the store: a record that is there has its video.
pub struct VideoSink {
    folder: PathBuf,
    running: HashMap<String, Video>,
}

impl VideoSink {
    /// For the run in `folder`.
    pub fn new(folder: PathBuf) -> VideoSink {
        VideoSink { folder, running: HashMap::new() }
    }

    fn start(&mut self, id: &str, image: &Image) -> Result<()> {
        let mut video = Video::new(image.height, image.width)?;
        video.push(&image.pixels)?;
        self.running.insert(id.to_owned(), video);
        Ok(())
    }

    fn write(&mut self, id: &str) -> Result<()> {
        let Some(video) = self.running.remove(id) else { return Ok(()) };
        let path = video_path(&self.folder, id);
        let folder = path.parent().context("a video has a folder")?;
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))?;
        write_whole(&path, &video.finish()?)
    }
}

impl EventSink for VideoSink {
    fn on(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Started { id, image: Some(image) } => self.start(id, image)?,
            Event::Stepped { id, image: Some(image) } => {
                if let Some(video) = self.running.get_mut(id) {
                    video.push(&image.pixels)?;
                }
            }
            Event::Recorded(record) => self.write(&record.identity.id())?,
            Event::Faulted(fault) => drop(self.running.remove(&fault.identity.id())),
            Event::Started { .. } | Event::Stepped { .. } | Event::Notice(_) => {}
        }
        Ok(())
    }
}
