//! The page's terms: one definition each, in a tooltip where the term stands and in a list at the end.

use super::escape::html;

const TERMS: [(&str, &str); 16] = [
    (
        "setting",
        "How candidates are drawn and chosen: strategy, number of candidates N and sampling temperature T.",
    ),
    (
        "strategy",
        "How one of the candidates of a step is chosen, for example by the verifier's score.",
    ),
    ("candidate", "One sampled completion of the policy: its reasoning and its action."),
    (
        "single sample",
        "One candidate is sampled and executed (N = 1): the policy without any choice.",
    ),
    (
        "verifier",
        "A learned model that scores each candidate with the probability that the episode will succeed.",
    ),
    (
        "score",
        "The verifier's probability that the episode succeeds if this candidate is executed.",
    ),
    (
        "advantage",
        "How much better the verifier ranks a candidate than the mean of its siblings, in percentage points of success where success and failure are equally likely. It is computed from the recorded scores.",
    ),
    ("siblings", "The other candidates that were sampled in the same step."),
    (
        "95 % interval",
        "If the experiment were repeated, 95 of 100 intervals made in this way would contain the true value. Episodes that share an initial layout are a cluster, which widens the interval.",
    ),
    (
        "paired",
        "Both settings ran on the same initial layouts with the same random numbers, so that their difference varies less than each of them.",
    ),
    ("initial layout", "Where the objects stand when an episode begins."),
    (
        "success",
        "The task is done at the last step of the episode. “Success, then lost” was done at some step, but not at the last one.",
    ),
    ("released", "Success with the gripper open and away from the object."),
    (
        "malformed",
        "A completion that holds no valid reasoning and action. It is never executed; if all candidates of a step are malformed, the robot holds still.",
    ),
    (
        "fault",
        "An attempt that broke: a server, a link or the simulation failed. It has no outcome, is in no rate, and the episode is run again.",
    ),
    (
        "headroom",
        "The share of the gap between a single sample and the oracle that a setting closes.",
    ),
];

/// The term with its definition as a tooltip; other terms than those of the list stay as they are.
pub fn term(name: &str) -> String {
    term_as(name, name)
}

/// The same, shown in other words.
pub fn term_as(name: &str, shown: &str) -> String {
    match TERMS.iter().find(|(known, _)| *known == name) {
        Some((_, definition)) => {
            let definition = html(definition);
            format!(
                "<abbr class=\"term\" tabindex=\"0\" data-definition=\"{definition}\">{}</abbr>",
                html(shown)
            )
        }
        None => html(shown),
    }
}

/// All terms with their definitions.
pub fn list() -> String {
    let entries = TERMS.iter().map(|(name, definition)| {
        format!("<div><dt>{}</dt><dd>{}</dd></div>", html(name), html(definition))
    });
    format!("<dl class=\"glossary\">{}</dl>", entries.collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_known_term_has_its_definition_and_another_is_plain_text() {
        assert!(term("fault").contains("An attempt that broke"));
        assert_eq!(term("a<b"), "a&lt;b");
        assert!(term_as("success", "success %").contains(">success %</abbr>"));
    }
}
