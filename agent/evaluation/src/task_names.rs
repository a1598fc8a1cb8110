//! Short names of tasks, for tables and for the command line.

use decision::{TaskId, VARIANT_DEFAULT};

/// The names of tasks in tables: the longest word that no other task's name contains, and the variant unless it is the
/// default. A task without such a word, or the only task, has its full name.
pub fn short_names(tasks: &[TaskId]) -> Vec<String> {
    let mut names: Vec<&str> = tasks.iter().map(|id| id.task.as_str()).collect();
    names.dedup();
    let short = |id: &TaskId| {
        let others = || names.iter().filter(|name| **name != id.task);
        let is_own = |word: &&str| !others().any(|name| words(name).any(|other| other == *word));
        let own = words(&id.task).filter(is_own);
        // The first of the longest.
        let longest = own.rev().max_by_key(|word| word.len());
        let name = longest.filter(|_| others().next().is_some()).unwrap_or(&id.task);
        match id.variant.as_str() {
            VARIANT_DEFAULT => name.to_owned(),
            variant => format!("{name}/{variant}"),
        }
    };
    tasks.iter().map(short).collect()
}

/// The offered task with this name: its full name, or consecutive words of it that no other task's name contains
/// (`stack`, `stack_cube` and `stack cube` are `widowx_stack_cube` among the Bridge tasks). The error is the most
/// similar task, if one is similar enough.
pub fn resolve(asked: &TaskId, offered: &[TaskId]) -> Result<TaskId, Option<TaskId>> {
    if offered.contains(asked) {
        return Ok(asked.clone());
    }
    let wanted: Vec<&str> = words(&asked.task).collect();
    let has_words = |id: &&TaskId| {
        let name: Vec<&str> = words(&id.task).collect();
        id.variant == asked.variant && name.windows(wanted.len()).any(|part| part == wanted)
    };
    let mut matching = offered.iter().filter(has_words);
    match (matching.next(), matching.next()) {
        (Some(only), None) => Ok(only.clone()),
        _ => Err(nearest(asked, offered)),
    }
}

fn nearest(asked: &TaskId, offered: &[TaskId]) -> Option<TaskId> {
    let asked = asked.to_string();
    let likeness = |id: &TaskId| {
        let names = std::iter::once(id.to_string()).chain(words(&id.task).map(str::to_owned));
        names.map(|name| strsim::jaro_winkler(&asked, &name)).fold(0.0, f64::max)
    };
    let best = offered.iter().max_by(|one, other| likeness(one).total_cmp(&likeness(other)))?;
    (likeness(best) > LIKENESS_MIN).then(|| best.clone())
}

/// Similarity above which one name is likely a misspelling of another (Jaro-Winkler, 0 to 1).
const LIKENESS_MIN: f64 = 0.8;

fn words(name: &str) -> impl DoubleEndedIterator<Item = &str> {
    name.split(['_', '-', ' ']).filter(|word| !word.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    const BRIDGE: [&str; 4] = [
        "widowx_spoon_on_towel",
        "widowx_carrot_on_plate",
        "widowx_stack_cube",
        "widowx_put_eggplant_in_basket",
    ];

    fn bridge() -> Vec<TaskId> {
        BRIDGE.map(TaskId::default_of).to_vec()
    }

    #[test]
    fn tables_show_the_word_that_tells_a_task_from_the_others() {
        assert_eq!(short_names(&bridge()), ["spoon", "carrot", "stack", "eggplant"]);
        assert_eq!(short_names(&bridge()[2..3]), ["widowx_stack_cube"]);
        let variants = ["default", "distractors"].map(|name| TaskId::new(BRIDGE[0], name));
        assert_eq!(
            short_names(&variants),
            ["widowx_spoon_on_towel", "widowx_spoon_on_towel/distractors"]
        );
    }

    #[test]
    fn words_that_only_one_task_has_stand_for_its_name() {
        let offered = bridge();
        for name in ["stack", "stack_cube", "stack cube", "stack-cube", "widowx_stack_cube"] {
            let resolved = resolve(&TaskId::default_of(name), &offered);
            assert_eq!(resolved, Ok(offered[2].clone()), "{name}");
        }
        let variant = TaskId::new(BRIDGE[1], "size-0.5");
        let both = [offered[1].clone(), variant.clone()];
        assert_eq!(resolve(&TaskId::new("carrot", "size-0.5"), &both), Ok(variant));
        assert!(resolve(&TaskId::default_of("widowx"), &offered).is_err(), "all have it");
        assert_eq!(resolve(&TaskId::default_of("stak"), &offered), Err(Some(offered[2].clone())));
        assert_eq!(resolve(&TaskId::default_of("nonsense"), &offered), Err(None));
    }
}
