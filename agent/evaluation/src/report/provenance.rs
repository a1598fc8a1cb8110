//! How the run came about: dates, command lines and builds to copy, options and versions by name.

use std::collections::BTreeSet;

use serde_json::Value;
use store::run::{RunHeader, RunStart};

use super::escape::html;

/// Letters that a shell takes as they are.
const PLAIN: &str = "-_./=,:+@%";

/// A command line as it can be pasted into a shell; the program by its name alone.
pub fn command_line(words: &[String]) -> String {
    let mut words = words.iter();
    let program = words.next().map_or("rever", |path| path.rsplit('/').next().unwrap_or(path));
    std::iter::once(program.to_owned())
        .chain(words.map(|word| quoted(word)))
        .collect::<Vec<_>>()
        .join(" ")
}

fn quoted(word: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || PLAIN.contains(letter);
    match !word.is_empty() && word.chars().all(is_plain) {
        true => word.to_owned(),
        false => format!("'{}'", word.replace('\'', "'\\''")),
    }
}

/// `2026-11-30T17:55:10Z` for people.
pub fn date(time: &str) -> String {
    match time.split_once('T') {
        Some((day, clock)) => format!("{day} {} UTC", clock.get(..5).unwrap_or(clock)),
        None => time.to_owned(),
    }
}

/// One block per start of the run, then options and versions.
pub fn section(header: &RunHeader, simulators: &BTreeSet<String>) -> String {
    let starts: String = header.starts.iter().map(start).collect();
    let mut facts = vec![fact("run", &header.run)];
    for object in [&header.options, &header.versions].map(Value::as_object).into_iter().flatten() {
        facts.extend(object.iter().filter_map(|(name, value)| fact_of(name, value)));
    }
    let simulators: Vec<&str> = simulators.iter().map(String::as_str).collect();
    facts.push(fact("simulator", &simulators.join(", ")));
    format!(
        "{starts}<details><summary>All options and versions</summary><dl class=\"facts\">{}</dl></details>",
        facts.concat()
    )
}

fn start(start: &RunStart) -> String {
    let RunStart { time, command, build } = start;
    format!(
        "<p class=\"start\"><span>Started {} with rever {}, commit <code class=\"copy\">{}</code></span>\
         <code class=\"copy block\">{}</code></p>",
        html(&date(time)),
        html(&build.version),
        html(&build.commit_text()),
        html(&command_line(command))
    )
}

/// None for an option that is not set.
fn fact_of(name: &str, value: &Value) -> Option<String> {
    let plain = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let name = match name {
        "seeds_from" => "first seed of the environments",
        "all_hidden" => "hidden states of all candidates kept",
        name => name,
    };
    let value = match value {
        Value::Null => return None,
        Value::Bool(flag) => if *flag { "yes" } else { "no" }.to_owned(),
        Value::Array(list) => list.iter().map(plain).collect::<Vec<_>>().join(", "),
        value => plain(value),
    };
    Some(fact(&name.replace('_', " "), &value))
}

/// A name and its value.
pub fn fact(name: &str, value: &str) -> String {
    format!("<div><dt>{}</dt><dd>{}</dd></div>", html(name), html(value))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_command_line_can_be_pasted() {
        let check = |words: &[&str], expected: &str| {
            let words: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
            assert_eq!(command_line(&words), expected);
        };
        check(&["/opt/bin/rever", "demo", "--seed=3"], "rever demo --seed=3");
        check(&["rever", "--out", "my run's"], "rever --out 'my run'\\''s'");
        check(&["rever", ""], "rever ''");
        assert_eq!(date("2026-11-30T17:55:10Z"), "2026-11-30 17:55 UTC");
    }

    #[test]
    fn options_that_are_not_set_are_left_out() {
        assert_eq!(fact_of("device", &Value::Null), None);
        let shown = fact_of("tasks", &json!(["a", "b<"])).expect("a fact");
        assert!(shown.contains("a, b&lt;"), "{shown}");
    }
}
