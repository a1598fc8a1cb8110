//! The worlds of one process: made when first needed, handed from session to session, limited.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::fault::Fault;
use crate::tasks::{Task, TaskId};
use crate::world::World;

/// Which worlds are alike.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key {
    pub task: String,
    pub variant: String,
    pub image_height: u32,
    pub image_width: u32,
}

/// Use it in the thread that renders.
///
/// A world carries nothing from one episode to the next, so it does not matter which one a session
/// gets. Making one takes tens of milliseconds.
pub struct Worlds {
    tasks: Vec<Arc<Task>>,
    idle_max: usize,
    idle: VecDeque<(Key, World)>,
}

impl Worlds {
    /// `idle_max`: worlds kept that no session uses.
    pub fn new(tasks: Vec<Task>, idle_max: usize) -> Worlds {
        let tasks = tasks.into_iter().map(Arc::new).collect();
        Worlds { tasks, idle_max, idle: VecDeque::new() }
    }

    /// All that is offered.
    pub fn tasks(&self) -> &[Arc<Task>] {
        &self.tasks
    }

    /// The task; refused when it is not offered.
    pub fn task(&self, name: &str, variant: &str) -> Result<&Arc<Task>, Fault> {
        let wanted = TaskId { task: name.to_owned(), variant: variant.to_owned() };
        self.tasks.iter().find(|task| task.id == wanted).ok_or_else(|| {
            let offered: Vec<String> = self.tasks.iter().map(|task| task.id.to_string()).collect();
            Fault::Wrong(format!("task {wanted}: expected one of {}", offered.join(", ")))
        })
    }

    /// A world for the caller alone.
    pub fn take(&mut self, key: &Key) -> Result<World, Fault> {
        if let Some(index) = self.idle.iter().position(|(idle, _)| idle == key)
            && let Some((_, world)) = self.idle.remove(index)
        {
            return Ok(world);
        }
        World::new(self.task(&key.task, &key.variant)?, key.image_height, key.image_width)
    }

    /// Keeps a sound world for the next taker; drops the one unused for longest if need be.
    pub fn give_back(&mut self, key: Key, world: World) {
        self.idle.push_back((key, world));
        if self.idle.len() > self.idle_max {
            self.idle.pop_front();
        }
    }
}
