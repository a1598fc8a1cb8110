//! What a server offers, and what must be alike of all servers of a run.

use std::collections::BTreeSet;

use decision::TaskId;
use protocol::{Description, TaskDescription};

/// What a server offers of a task.
pub fn offered<'a>(server: &'a Description, task: &TaskId) -> Option<&'a TaskDescription> {
    server.tasks.iter().find(|one| one.task == task.task && one.variant == task.variant)
}

/// What of a task is not as the run's first server describes it.
pub fn difference(first: &TaskDescription, offer: &TaskDescription) -> Option<String> {
    let (name, expected, got) = texts(first)
        .into_iter()
        .zip(texts(offer))
        .map(|((name, expected), (_, got))| (name, expected, got))
        .find(|(_, expected, got)| expected != got)?;
    Some(format!("expected {name} of the run's other episodes, {expected}, got {got}"))
}

/// What all servers of a run must say alike of a task.
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

/// What a run's episodes must have in common: a task of another version has other results.
pub fn simulator(server: &Description) -> String {
    let name = format!("{} {}", server.simulator, server.simulator_version);
    let versions: BTreeSet<u32> = server.tasks.iter().map(|task| task.version).collect();
    // Left out where every task is its first version, as in runs from before there was a second.
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
    fn what_a_task_is_not_described_alike_in_is_named() {
        let first = description("stack");
        assert_eq!(difference(&first, &first), None);
        let longer = TaskDescription { steps_max: first.steps_max + 7, ..first.clone() };
        let (expected, got) = (first.steps_max, longer.steps_max);
        let text =
            format!("expected the horizon of the run's other episodes, {expected}, got {got}");
        assert_eq!(difference(&first, &longer), Some(text));
        let renamed = TaskDescription { instruction: "stack them".to_owned(), ..first.clone() };
        let text =
            "expected the instruction of the run's other episodes, \"stack\", got \"stack them\"";
        assert_eq!(difference(&first, &renamed).as_deref(), Some(text));
    }
}
