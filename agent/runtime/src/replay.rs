//! Repeats a recorded episode: the same reset, the same actions, and a check that states and statistics are equal.

use anyhow::{Context, Result, ensure};
use protocol::{Image, Reset};
use store::record::EpisodeRecord;

use crate::session::{Environment, Episode};

/// Repeats a recorded episode on a session and passes its images to `on_image`, the first before the first step. Fails if
/// a state or statistic differs from the record.
pub async fn replay<E: Environment>(
    environment: E,
    record: &EpisodeRecord,
    mut on_image: impl FnMut(&Image) -> Result<()> + Send,
) -> Result<<E::Episode as Episode>::Environment> {
    let identity = &record.identity;
    let reset = Reset {
        task: identity.task.clone(),
        variant: identity.variant.clone(),
        layout: identity.layout,
        seed: identity.seed,
    };
    let mut episode = environment.reset(reset).await.context("reset")?;
    on_image(&episode.observation().image)?;
    for (index, step) in record.steps.iter().enumerate() {
        ensure!(
            episode.observation().state == step.state,
            "step {index}: the robot is not where it was when the episode was recorded"
        );
        let transition =
            episode.step(&step.action).await.with_context(|| format!("step {index}"))?;
        ensure!(
            transition.statistics == step.statistics,
            "step {index}: expected {:?}, got {:?}",
            step.statistics,
            transition.statistics
        );
        on_image(&episode.observation().image)?;
    }
    Ok(episode.finish())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scripted::{STEPS_MAX, ScriptedPool};
    use crate::session::{SessionPool, SessionRequest};
    use decision::TaskId;
    use protocol::Statistics;
    use store::record::{EpisodeIdentity, RECORD_VERSION, StepRecord};

    /// What a scripted environment does: success at the last step.
    fn record() -> EpisodeRecord {
        let step = |index: u32| StepRecord {
            state: vec![0.0; 8],
            decision: None,
            action: vec![0.0; 7],
            statistics: Statistics { is_success: index + 1 == STEPS_MAX, ..Statistics::default() },
            step_ms: 1.0,
            simulator_ms: 1.0,
        };
        EpisodeRecord {
            version: RECORD_VERSION,
            identity: EpisodeIdentity {
                run: "run".into(),
                task: "stack".into(),
                variant: "default".into(),
                layout: None,
                episode: 0,
                seed: 1,
                sampling_seed: 2,
                strategy: "sample".into(),
                candidates: 1,
                temperature: 1.0,
            },
            versions: crate::tests::versions(),
            instruction: "stack".into(),
            steps_max: STEPS_MAX,
            statistics: Statistics::default(),
            steps: (0..STEPS_MAX).map(step).collect(),
            wall_secs: 1.0,
        }
    }

    async fn images(record: &EpisodeRecord) -> Result<usize> {
        let pool = ScriptedPool::new(&[]);
        let request = SessionRequest { task: TaskId::default_of("stack"), needs_expert: false };
        let session = pool.acquire(&request).await?;
        let mut count = 0;
        replay(session.environment, record, |_| {
            count += 1;
            Ok(())
        })
        .await?;
        Ok(count)
    }

    #[tokio::test]
    async fn an_episode_is_repeated_with_an_image_before_and_after_every_step() {
        assert_eq!(images(&record()).await.expect("the same"), STEPS_MAX as usize + 1);
    }

    #[tokio::test]
    async fn another_course_than_the_recorded_one_is_an_error() {
        let mut moved = record();
        moved.steps[1].state[0] = 0.5;
        let error = images(&moved).await.expect_err("elsewhere").to_string();
        assert!(error.starts_with("step 1: the robot is not where it was"), "{error}");
        let mut failed = record();
        failed.steps[STEPS_MAX as usize - 1].statistics.is_success = false;
        let error = images(&failed).await.expect_err("another outcome").to_string();
        assert!(error.starts_with("step 2: expected Statistics"), "{error}");
    }
}
