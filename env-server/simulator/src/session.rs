//! A leased session: its numbered requests, its environment, its saved states.

use std::collections::BTreeMap;
use std::time::Instant;

use bytes::Bytes;
use protocol::{CodecError, FaultKind, Image, Observation, Open, Reply, Request, encode, limits};

use crate::fault::Fault;
use crate::world::{Snapshot, World};
use crate::worlds::{Key, Worlds};

/// Replies to every request exactly once. Use it in the thread that renders.
pub struct Session {
    /// Number of executed steps.
    pub steps: u64,
    /// Whether it was closed; it still answers a repeated `Close`.
    pub closed: bool,
    opened: Open,
    last_sequence: u64,
    last_reply: Bytes,
    /// The last observed image, as its holder has it.
    last_image: Option<Image>,
    is_running: bool,
    slots: BTreeMap<u32, Snapshot>,
    world: Option<(Key, World)>,
}

impl Session {
    /// A session for an offered task, with its own environment.
    pub fn new(opened: Open, worlds: &mut Worlds) -> Result<Session, Fault> {
        let key = key(&opened, &opened.task, &opened.variant);
        let world = worlds.take(&key)?;
        Ok(Session {
            steps: 0,
            closed: false,
            opened,
            last_sequence: 0,
            last_reply: Bytes::new(),
            last_image: None,
            is_running: false,
            slots: BTreeMap::new(),
            world: Some((key, world)),
        })
    }

    /// The reply's bytes; `None` if the request is older than the last one.
    pub fn answer(&mut self, bytes: &[u8], worlds: &mut Worlds) -> Option<Bytes> {
        let (request, refusal) = match protocol::codec::parse::<Request>(bytes) {
            Ok((request, invalid)) => (request, invalid),
            Err(error) => return Some(refused(0, &error.to_string())),
        };
        let sequence = request.sequence();
        if !(1..limits::SEED_END).contains(&sequence) {
            return Some(refused(0, &words(refusal)));
        }
        if sequence < self.last_sequence {
            return None;
        }
        if sequence == self.last_sequence {
            return Some(self.last_reply.clone());
        }
        let expected = self.last_sequence + 1;
        if sequence != expected {
            return Some(refused(
                sequence,
                &format!("sequence: expected {expected}, got {sequence}"),
            ));
        }
        let reply = match refusal {
            Some(error) => refused(sequence, &error.to_string()),
            None => self.perform(request, worlds),
        };
        self.last_sequence = sequence;
        self.last_reply = reply.clone();
        Some(reply)
    }

    /// Returns the environment to the pool.
    pub fn end(&mut self, worlds: &mut Worlds) {
        self.closed = true;
        self.is_running = false;
        self.slots.clear();
        self.release(worlds);
    }

    fn perform(&mut self, request: Request, worlds: &mut Worlds) -> Bytes {
        let sequence = request.sequence();
        let reply = self.reply(request, worlds).and_then(|reply| {
            encode(&reply).map_err(|error| Fault::Internal(format!("CodecError: {error}")))
        });
        match reply {
            Ok(bytes) => bytes.into(),
            Err(fault) => match fault.kind() {
                None => refused(sequence, &fault.to_string()),
                Some(kind) => self.faulted(sequence, kind, &fault.to_string()),
            },
        }
    }

    fn reply(&mut self, request: Request, worlds: &mut Worlds) -> Result<Reply, Fault> {
        let name = name(&request);
        if self.closed {
            return Err(Fault::Wrong(format!("expected nothing after Close, got {name}")));
        }
        let request = match request {
            Request::Reset { sequence, task, variant, layout, seed } => {
                worlds.task(&task, &variant)?;
                let key = key(&self.opened, &task, &variant);
                let observation = self.reset(key, layout, seed, worlds)?;
                self.slots.clear();
                self.is_running = true;
                self.last_image = Some(observation.image.clone());
                return Ok(Reply::Observed { sequence, observation: self.seen(observation)? });
            }
            Request::Close { sequence } => {
                self.end(worlds);
                return Ok(Reply::Closed { sequence });
            }
            other => other,
        };
        let Some((_, world)) = self.world.as_mut().filter(|_| self.is_running) else {
            return Err(Fault::Wrong(format!("expected Reset first, got {name}: no episode runs")));
        };
        match request {
            Request::Step { sequence, action } => {
                let begun = Instant::now();
                let mut transition = world.step(&action)?;
                let simulator_us = begun.elapsed().as_micros().try_into().unwrap_or(u32::MAX);
                self.steps += 1;
                transition.observation = self.seen(transition.observation)?;
                let image = &mut transition.observation.image;
                let whole = image.clone();
                let changes = self.last_image.as_ref().and_then(|last| whole.changes(last));
                let changed_tiles = changes.map(|(tiles, pixels)| {
                    image.pixels = pixels;
                    tiles
                });
                self.last_image = Some(whole);
                Ok(Reply::Stepped { sequence, transition, changed_tiles, simulator_us })
            }
            Request::Save { sequence, slot } => {
                self.slots.insert(slot, world.save()?);
                Ok(Reply::Saved { sequence })
            }
            Request::Restore { sequence, slot } => {
                let Some(snapshot) = self.slots.get(&slot) else {
                    let slots: Vec<u32> = self.slots.keys().copied().collect();
                    return Err(Fault::Wrong(format!(
                        "slot: expected one of {slots:?}, got {slot}"
                    )));
                };
                let observation = world.restore(snapshot)?;
                self.last_image = Some(observation.image.clone());
                Ok(Reply::Restored { sequence, observation: self.seen(observation)? })
            }
            Request::Reset { .. } | Request::Close { .. } => unreachable!("answered above"),
        }
    }

    /// Resets the current environment, or replaces it by one for another task. A refused reset
    /// leaves it unchanged.
    fn reset(
        &mut self,
        key: Key,
        layout: Option<u32>,
        seed: u64,
        worlds: &mut Worlds,
    ) -> Result<Observation, Fault> {
        if let Some((_, world)) = self.world.as_mut().filter(|(current, _)| *current == key) {
            return world.reset(layout, seed);
        }
        let mut world = worlds.take(&key)?;
        let observation = world.reset(layout, seed);
        if observation.as_ref().is_err_and(|fault| fault.kind().is_none()) {
            worlds.give_back(key, world);
            return observation;
        }
        self.release(worlds);
        self.world = Some((key, world)); // after a fault it is dropped by `faulted`
        observation
    }

    /// The environment may be broken permanently: the next Reset uses another one.
    fn faulted(&mut self, sequence: u64, kind: FaultKind, reason: &str) -> Bytes {
        self.is_running = false;
        self.slots.clear();
        self.world = None;
        written(&Reply::Faulted { sequence, kind, reason: short(reason) })
    }

    fn release(&mut self, worlds: &mut Worlds) {
        if let Some((key, world)) = self.world.take() {
            worlds.give_back(key, world);
        }
    }

    /// The observation, with the expert's action in a session opened with `expert`.
    fn seen(&self, observation: Observation) -> Result<Observation, Fault> {
        let expert_action = match &self.world {
            Some((_, world)) if self.opened.expert => Some(world.expert_action()?.to_vec()),
            _ => None,
        };
        Ok(Observation { expert_action, ..observation })
    }
}

/// The encoding of a refusal.
pub fn refused(sequence: u64, reason: &str) -> Bytes {
    written(&Reply::Refused { sequence, reason: short(reason) })
}

fn written(reply: &Reply) -> Bytes {
    encode(reply).expect("a reason within its limit can be encoded").into()
}

fn words(error: Option<CodecError>) -> String {
    error.map(|error| error.to_string()).unwrap_or_default()
}

fn key(opened: &Open, task: &str, variant: &str) -> Key {
    Key {
        task: task.to_owned(),
        variant: variant.to_owned(),
        image_height: opened.image_height,
        image_width: opened.image_width,
    }
}

fn name(request: &Request) -> &'static str {
    match request {
        Request::Reset { .. } => "Reset",
        Request::Step { .. } => "Step",
        Request::Save { .. } => "Save",
        Request::Restore { .. } => "Restore",
        Request::Close { .. } => "Close",
    }
}

/// Cuts a reason to the protocol's limit on texts.
fn short(reason: &str) -> String {
    reason[..reason.floor_char_boundary(limits::TEXT_BYTES_MAX)].to_owned()
}
