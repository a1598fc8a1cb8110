//! A task in one variant.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The variant of a task unless another is requested.
pub const VARIANT_DEFAULT: &str = "default";

/// A task in one variant, named as in a server's description.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskId {
    /// Name of the task. The Bridge tasks have SIMPLER's names.
    pub task: String,
    /// `default`, or the name of what is changed.
    pub variant: String,
}

impl TaskId {
    /// A task in a variant.
    pub fn new(task: impl Into<String>, variant: impl Into<String>) -> TaskId {
        TaskId { task: task.into(), variant: variant.into() }
    }

    /// A task in its default variant.
    pub fn default_of(task: impl Into<String>) -> TaskId {
        TaskId::new(task, VARIANT_DEFAULT)
    }
}

impl fmt::Display for TaskId {
    /// `task`, or `task/variant` for a variant other than the default.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.variant == VARIANT_DEFAULT {
            formatter.pad(&self.task)
        } else {
            formatter.pad(&format!("{}/{}", self.task, self.variant))
        }
    }
}

impl FromStr for TaskId {
    type Err = String;

    /// Parses `task` or `task/variant`. A task's name may contain slashes (`ALE/Pong-v5/default`):
    /// the variant follows the last one.
    fn from_str(text: &str) -> Result<TaskId, String> {
        let (task, variant) = text.rsplit_once('/').unwrap_or((text, VARIANT_DEFAULT));
        if task.is_empty() || variant.is_empty() {
            return Err(format!("task: expected TASK or TASK/VARIANT, got {text:?}"));
        }
        Ok(TaskId::new(task, variant))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_id_is_read_back_from_its_text() {
        for (text, task, variant) in
            [("stack", "stack", "default"), ("stack/wide", "stack", "wide"), ("a/b/c", "a/b", "c")]
        {
            let id: TaskId = text.parse().expect("a task");
            assert_eq!(id, TaskId::new(task, variant));
            assert_eq!(id.to_string(), text);
        }
        for text in ["", "/wide", "stack/"] {
            let error = text.parse::<TaskId>().expect_err("refused");
            assert!(error.starts_with("task: expected TASK or TASK/VARIANT"), "{error}");
        }
    }
}
