//! How each strategy chooses, for the page's reader.

use decision::{Setting, Strategy};

/// How a setting chooses the candidate that is executed, as a sentence.
pub fn choice(setting: Setting) -> &'static str {
    if setting.candidates <= 1 && setting.strategy != Strategy::Greedy {
        return "One candidate was sampled and executed: there was no choice.";
    }
    match setting.strategy {
        Strategy::Greedy => {
            "One candidate of the likeliest tokens was decoded and executed: there was no choice."
        }
        Strategy::Sample => "The first candidate is executed, whatever the scores are.",
        Strategy::FirstWellFormed => {
            "The first well-formed candidate is executed, whatever the scores are."
        }
        Strategy::Majority => "The candidate that most of the others agree with is executed.",
        Strategy::Medoid => {
            "The candidate whose action is nearest to all others (the medoid) is executed."
        }
        Strategy::Verifier => "The candidate with the highest score is executed.",
        Strategy::Worst => "The candidate with the lowest score is executed, as a control.",
        Strategy::VerifierMedoid => "The score minus the distance to the other candidates decides.",
        Strategy::Oracle => {
            "The candidate nearest to the scripted expert's action is executed: an upper bound that needs the simulator."
        }
    }
}
