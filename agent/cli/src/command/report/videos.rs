//! `rever report --video`: renders the episodes of a run that have no video, from their records.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use indicatif::ProgressBar;
use runtime::replay::replay;
use runtime::servers::{Deployment, LocalSource, ServerSource};
use runtime::session::{Session, SessionPool, SessionRequest};
use runtime::wire::{PoolOptions, ZenohPool};
use store::record::EpisodeRecord;
use store::run;
use store::video::Video;

/// Height and width of the images: larger than a policy's, for people. Physics do not depend on them.
const IMAGE_SIZE: (usize, usize) = (240, 320);
/// Timeout for a session.
const SESSION_WAIT: Duration = Duration::from_secs(60);

/// Renders the missing videos of the first `episodes_max` episodes into the run's folder. Returns their number.
pub fn render(folder: &Path, local: LocalSource, episodes_max: usize) -> Result<usize> {
    let ids = run::recorded(folder)?.into_iter().take(episodes_max);
    let missing = ids.filter(|id| !run::video_path(folder, id).is_file());
    let missing: Vec<String> = missing.collect();
    let Some(first) = missing.first() else { return Ok(0) };
    let videos = run::video_path(folder, first);
    check_writable(videos.parent().context("a video lies in a folder")?)?;
    let first = EpisodeRecord::read(&run::record_path(folder, first))?;
    let source = ServerSource {
        local: Some(local),
        connect: Vec::new(),
        listen: Vec::new(),
        fleet: "report".to_owned(),
    };
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    let deployment = source.open(&runtime, 1)?;
    let result = runtime.block_on(render_all(folder, &deployment, &first, &missing));
    deployment.close(&runtime)?;
    result.map(|()| missing.len())
}

/// Checked before servers start: a run may belong to another user.
fn check_writable(videos: &Path) -> Result<()> {
    std::fs::create_dir_all(videos)
        .and_then(|()| tempfile::tempfile_in(videos).map(drop))
        .with_context(|| {
            format!("cannot write videos into {}; copy the run to render them", videos.display())
        })
}

async fn render_all(
    folder: &Path,
    deployment: &Deployment,
    first: &EpisodeRecord,
    missing: &[String],
) -> Result<()> {
    deployment.first_servers().await?;
    let options = PoolOptions {
        image_size: IMAGE_SIZE,
        action_length: first.steps.first().map_or(0, |step| step.action.len()),
        holder: "report".to_owned(),
        simulator: Some(first.versions.simulator.clone()),
        first_wait: SESSION_WAIT,
        wait: SESSION_WAIT,
    };
    let pool = ZenohPool::new(deployment.network.clone(), deployment.local.clone(), options);
    let waiting = Mutex::new(missing.iter().collect::<VecDeque<_>>());
    let bar = ProgressBar::new(missing.len() as u64).with_prefix("videos");
    bar.set_style(super::bar_style());
    let work = async || -> Result<()> {
        loop {
            let next = waiting.lock().ok().and_then(|mut waiting| waiting.pop_front());
            let Some(id) = next else { return Ok(()) };
            render_one(folder, &pool, id).await.with_context(|| format!("episode {id}"))?;
            bar.inc(1);
        }
    };
    // Two servers of one session each.
    let done = tokio::try_join!(work(), work());
    bar.finish_and_clear();
    done.map(drop)
}

async fn render_one(folder: &Path, pool: &ZenohPool, id: &str) -> Result<()> {
    let record = EpisodeRecord::read(&run::record_path(folder, id))?;
    let request = SessionRequest { task: record.identity.task_id(), needs_expert: false };
    let Session { info, environment } = pool.acquire(&request).await?;
    let (expected, found) = (&record.versions.simulator, &info.simulator);
    ensure!(
        expected == found,
        "it was recorded in the simulator {expected}, and the servers have {found} (--simulator)"
    );
    let mut video = Video::new(IMAGE_SIZE.0, IMAGE_SIZE.1)?;
    let environment = replay(environment, &record, |image| video.push(&image.pixels)).await?;
    pool.release(Session { info, environment });
    run::write_video(folder, id, &video.finish()?)
}
