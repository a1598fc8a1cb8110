//! The tasks that servers offer, and the requirement that all servers of a run agree.

use std::collections::BTreeSet;

use decision::TaskId;
use protocol::{Description, TaskDescription};

/// A server's description of a task.
pub fn offered<'a>(server: &'a Description, task: &TaskId) -> Option<&'a TaskDescription> {
    server.tasks.iter().find(|one| one.task == task.task && one.variant == task.variant)
}

/// The first difference between two descriptions of a task; `first` is that of the run's first
/// server.
pub fn difference(first: &TaskDescription, offer: &TaskDescription) -> Option<String> {
    let (name, expected, got) = texts(first)
        .into_iter()
        .zip(texts(offer))
        .map(|((name, expected), (_, got))| (name, expected, got))
        .find(|(_, expected, got)| expected != got)?;
    Some(format!("{name} differs from the run's other episodes: expected {expected}, got {got}"))
}

/// The properties of a task that must be equal on all servers of a run.
fn texts(task: &TaskDescription) -> [(&'static str, String); 6] {
    [
        ("the instruction", format!("{:?}", task.instruction)),
        ("the horizon", task.steps_max.to_string()),
        ("the control rate", format!("{:?}", task.control_hz)),
        ("the number of layouts", task.layouts.to_string()),
        ("the state", format!("{:?}", task.state)),
        ("the action", format!("{:?}", task.action)),
    ]
}

/// The simulator with its versions, which all episodes of a run must share: another task version
/// gives other results.
pub fn simulator(server: &Description) -> String {
    let name = format!("{} {}", server.simulator, server.simulator_version);
    let versions: BTreeSet<u32> = server.tasks.iter().map(|task| task.version).collect();
    // Omitted if every task has version 1, as in runs from before version 2 existed.
    if versions.iter().all(|&version| version == 1) {
        return name;
    }
    let versions: Vec<String> = versions.iter().map(u32::to_string).collect();
    format!("{name}, task version {}", versions.join(" and "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scripted::description;

    #[test]
    fn a_difference_between_task_descriptions_is_named() {
        let first = description("stack");
        assert_eq!(difference(&first, &first), None);
        let longer = TaskDescription { steps_max: first.steps_max + 7, ..first.clone() };
        let (expected, got) = (first.steps_max, longer.steps_max);
        let text = format!(
            "the horizon differs from the run's other episodes: expected {expected}, got {got}"
        );
        assert_eq!(difference(&first, &longer), Some(text));
        let renamed = TaskDescription { instruction: "stack them".to_owned(), ..first.clone() };
        let text = "the instruction differs from the run's other episodes: expected \"stack\", got \"stack them\"";
        assert_eq!(difference(&first, &renamed).as_deref(), Some(text));
    }
}
