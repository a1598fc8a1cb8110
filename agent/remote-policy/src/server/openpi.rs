//! openpi's wire: metadata first, then an observation and a result in turn. The wire has no episodes:
//! a connection begins one, a changed prompt the next, unless the client names them in
//! `rever.episode`.

use std::time::{Duration, Instant};

use anyhow::Result;

use super::agent::ServedAgent;
use super::reply;
use super::session::{Decided, Session};
use crate::codec::extension::{self, Ask};
use crate::codec::{Value, actions_array, encode, openpi};

/// One client.
pub(super) struct OpenpiClient {
    session: Session,
    /// The name or the prompt that began the current episode.
    episode: Option<Episode>,
    /// Number of episodes that had no name of their own.
    unnamed: u64,
    /// Time of the last request, from its frame to its reply.
    previous: Option<Duration>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Episode {
    Named(String),
    Prompt(String),
}

impl OpenpiClient {
    pub(super) fn new(session: Session) -> OpenpiClient {
        OpenpiClient { session, episode: None, unnamed: 0, previous: None }
    }

    /// The answer to an observation. After an error the connection is closed.
    pub(super) async fn answer(&mut self, frame: &[u8]) -> Result<Vec<u8>> {
        let begun = Instant::now();
        let (observation, ask) = {
            let map = openpi::map(frame)?;
            let agent = self.session.agent();
            let observation = agent.options.keys.read(&map, agent.info())?;
            (observation, Ask::read(&map)?.unwrap_or_default())
        };
        self.follow_episode(&observation.instruction, &ask);
        let Decided { decision, batch_time } = self.session.decide(observation, &ask).await?;
        let agent = self.session.agent();
        let actions = actions_array(&reply::actions(agent, &decision))?;
        let answer = reply::answer(agent, &decision, ask.candidates.is_some())?;
        let milliseconds = |time: Duration| Value::Float(time.as_secs_f64() * 1e3);
        let mut timing = vec![("infer_ms", milliseconds(batch_time))];
        timing.extend(self.previous.map(|time| ("prev_total_ms", milliseconds(time))));
        let result = Value::map([
            ("actions", actions.into_value(openpi::KEYS)),
            ("server_timing", Value::map(timing)),
            (extension::KEY, answer.value(openpi::KEYS)?),
        ]);
        let bytes = encode(&result)?;
        self.previous = Some(begun.elapsed());
        Ok(bytes)
    }

    /// Begins an episode if this observation is the first of one.
    fn follow_episode(&mut self, prompt: &str, ask: &Ask) {
        let episode = match &ask.episode {
            Some(name) => Episode::Named(name.clone()),
            None => Episode::Prompt(prompt.to_owned()),
        };
        if self.session.is_running() && self.episode.as_ref() == Some(&episode) {
            return;
        }
        match &episode {
            Episode::Named(name) => self.session.begin(name, prompt),
            Episode::Prompt(prompt) => {
                self.session.begin(&format!("{prompt}/default/{}", self.unnamed), prompt);
                self.unnamed += 1;
            }
        }
        self.episode = Some(episode);
    }
}

/// The first frame of a connection.
pub(super) fn metadata(agent: &ServedAgent) -> Result<Vec<(&'static str, Value<'static>)>> {
    let (height, width) = agent.info().image_size;
    let size = [height, width].map(|side| Value::Integer(side as i128));
    Ok(vec![
        ("server", Value::text("rever")),
        ("image_size", Value::List(size.to_vec())),
        (extension::KEY, agent.announcement().value(openpi::KEYS)?),
    ])
}
