//! Encodes the frames of running episodes and keeps the videos of recorded ones.

use std::collections::HashMap;
use std::path::PathBuf;

use anyhow::Result;
use protocol::Image;
use store::run::write_video;
use store::video::Video;

use super::{Event, EventSink};

/// Writes videos into a run's folder. It must come before the store sink, so that the video of
/// every record exists.
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
        write_video(&self.folder, id, &video.finish()?)
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
