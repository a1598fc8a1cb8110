//! Task selection: matches the names on the command line with the tasks that servers offer.

use anyhow::Result;
use decision::TaskId;
use evaluation::task_names::resolve;
use runtime::experiment;
use runtime::servers::Deployment;
use store::plan::OfferedTask;
use tokio::runtime::Runtime;

use super::WrongUsage;

/// The requested tasks as servers offer them, without duplicates. By default all tasks in their default variant.
pub fn offered(
    asked: &[TaskId],
    deployment: &Deployment,
    runtime: &Runtime,
) -> Result<Vec<OfferedTask>> {
    if asked.is_empty() {
        return runtime.block_on(experiment::default_tasks(deployment));
    }
    let is_known = |offered: &[OfferedTask]| matching(asked, &ids(offered)).is_ok();
    let offered = runtime.block_on(experiment::offered_tasks(deployment, is_known))?;
    let ids = matching(asked, &ids(&offered))?;
    let find = |id: &TaskId| offered.iter().find(|task| task.id == *id).cloned();
    Ok(ids.iter().filter_map(find).collect())
}

/// Full names of the requested tasks, without duplicates and in the order of the command line.
pub fn matching(asked: &[TaskId], offered: &[TaskId]) -> Result<Vec<TaskId>> {
    let mut tasks: Vec<TaskId> = Vec::new();
    for name in asked {
        let task = resolve(name, offered).map_err(|nearest| {
            let tip = nearest.map_or_else(String::new, |task| format!("; did you mean {task}?"));
            let names: Vec<String> = offered.iter().map(TaskId::to_string).collect();
            WrongUsage(format!("--tasks: expected one of {}, got {name}{tip}", names.join(", ")))
        })?;
        if !tasks.contains(&task) {
            tasks.push(task);
        }
    }
    Ok(tasks)
}

fn ids(offered: &[OfferedTask]) -> Vec<TaskId> {
    offered.iter().map(|task| task.id.clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_is_run_once_and_a_wrong_one_is_refused_with_a_suggestion() {
        let offered = ["widowx_stack_cube", "widowx_spoon_on_towel"].map(TaskId::default_of);
        let asked = ["spoon", "stack", "widowx_spoon_on_towel"].map(TaskId::default_of);
        let tasks = matching(&asked, &offered).expect("both are offered");
        assert_eq!(tasks, [offered[1].clone(), offered[0].clone()]);
        let error = matching(&[TaskId::default_of("spon")], &offered).expect_err("misspelt");
        assert!(error.is::<WrongUsage>());
        let expected = "--tasks: expected one of widowx_stack_cube, widowx_spoon_on_towel, got spon; did you mean \
                        widowx_spoon_on_towel?";
        assert_eq!(error.to_string(), expected);
    }
}
