//! The environments of one process: created on demand, reused by sessions, limited in number.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::fault::Fault;
use crate::tasks::{Task, TaskId};
use crate::world::World;

/// Environments with equal keys are interchangeable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key {
    pub task: String,
    pub variant: String,
    pub image_height: u32,
    pub image_width: u32,
}

/// A pool of environments. Use it in the thread that renders.
///
/// An environment keeps no state between episodes, so a session may get any one. Creating one takes
/// tens of milliseconds.
pub struct Worlds {
    tasks: Vec<Arc<Task>>,
    idle_max: usize,
    idle: VecDeque<(Key, World)>,
}

impl Worlds {
    /// `idle_max` is the maximum number of idle environments.
    pub fn new(tasks: Vec<Task>, idle_max: usize) -> Worlds {
        let tasks = tasks.into_iter().map(Arc::new).collect();
        Worlds { tasks, idle_max, idle: VecDeque::new() }
    }

    /// All offered tasks.
    pub fn tasks(&self) -> &[Arc<Task>] {
        &self.tasks
    }

    /// The task; an error if it is not offered.
    pub fn task(&self, name: &str, variant: &str) -> Result<&Arc<Task>, Fault> {
        let wanted = TaskId { task: name.to_owned(), variant: variant.to_owned() };
        self.tasks.iter().find(|task| task.id == wanted).ok_or_else(|| {
            let offered: Vec<String> = self.tasks.iter().map(|task| task.id.to_string()).collect();
            Fault::Wrong(format!("task {wanted}: expected one of {}", offered.join(", ")))
        })
    }

    /// An environment for exclusive use.
    pub fn take(&mut self, key: &Key) -> Result<World, Fault> {
        if let Some(index) = self.idle.iter().position(|(idle, _)| idle == key)
            && let Some((_, world)) = self.idle.remove(index)
        {
            return Ok(world);
        }
        World::new(self.task(&key.task, &key.variant)?, key.image_height, key.image_width)
    }

    /// Returns an intact environment to the pool; removes the one idle for longest if there are too
    /// many.
    pub fn give_back(&mut self, key: Key, world: World) {
        self.idle.push_back((key, world));
        if self.idle.len() > self.idle_max {
            self.idle.pop_front();
        }
    }
}
