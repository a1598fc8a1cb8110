//! The optional fields that this project adds to openpi's maps and to the payloads of vla-eval,
//! under the one key `rever`. Peers that do not know them ignore them.

use anyhow::{Context, Result, bail, ensure};

use super::{Array, IMAGE_SIDE_MAX, KeyForm, Value, actions, printable};

/// The key of all fields.
pub const KEY: &str = "rever";
/// The version of the fields.
pub const VERSION: i128 = 1;
/// Maximum number of candidates in a reply.
pub const CANDIDATES_MAX: usize = 256;
/// Maximum number of tokens, or of numbers in a hidden state, of a candidate.
const NUMBERS_MAX: usize = 1 << 16;
/// Maximum length of a candidate's reasoning.
const REASONING_BYTES_MAX: usize = 1 << 16;
/// Maximum length of an episode's name or of a digest.
const NAME_BYTES_MAX: usize = 256;

/// What a server with these fields can do: in openpi's metadata and in vla-eval's `capabilities`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Announcement {
    /// Maximum number of candidates per request.
    pub candidates_max: usize,
    /// Identity of the policy's computation.
    pub digest: Option<String>,
    /// Whether temperature 0 gives the most likely action.
    pub is_greedy: bool,
    /// Height and width of the images that the policy sees.
    pub image_size: Option<(usize, usize)>,
    /// Length of a candidate's hidden state.
    pub hidden_size: Option<usize>,
    /// Number of parts in a candidate's confidence.
    pub confidence_size: Option<usize>,
    /// The unit of each dimension of an action, for distances between candidates.
    pub action_scale: Option<Vec<f32>>,
}

/// What a client asks for, in an observation.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Ask {
    /// Number of candidates.
    pub candidates: Option<usize>,
    /// Sampling temperature; 0 is greedy.
    pub temperature: Option<f32>,
    /// Seed of the sampling.
    pub seed: Option<u64>,
    /// A new value begins an episode. Only for openpi, whose wire does not tell.
    pub episode: Option<String>,
}

/// What a server adds to its actions.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Answer {
    /// Index of the candidate whose actions the reply holds.
    pub chosen: Option<usize>,
    /// All candidates.
    pub candidates: Vec<AnswerCandidate>,
    /// Identity of the policy's computation.
    pub digest: Option<String>,
}

/// One candidate. Empty lists are left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct AnswerCandidate {
    /// Its actions; none if it is malformed.
    pub actions: Vec<Vec<f32>>,
    /// The text before the action.
    pub reasoning: Option<String>,
    /// Why there are no actions.
    pub malformed: Option<String>,
    /// The server's own score, larger is better.
    pub score: Option<f32>,
    /// All tokens of the completion.
    pub tokens: Vec<u32>,
    /// The action's tokens, one per number of `actions`.
    pub action_tokens: Vec<u32>,
    /// Log-probability of the completion at temperature 1.
    pub log_probability: Option<f32>,
    /// Log-probability of each token at temperature 1.
    pub log_probabilities: Vec<f32>,
    /// Log-probability of each part of the reasoning and of each dimension of the action.
    pub confidence: Vec<f32>,
    /// Hidden state of the last token.
    pub hidden: Vec<f32>,
}

/// The fields in a map, if it has them.
fn fields<'a, 'b>(map: &'b Value<'a>) -> Result<Option<&'b Value<'a>>> {
    let Some(fields) = map.get(KEY) else { return Ok(None) };
    fields.entries().context(KEY)?;
    Ok(Some(fields))
}

impl Announcement {
    /// Whether a learned verifier can read this server's candidates.
    pub fn has_hidden(&self) -> bool {
        self.hidden_size.is_some()
            && self.confidence_size.is_some()
            && self.digest.is_some()
            && self.action_scale.is_some()
    }

    /// Reads the announcement of a server; `None` if it makes none.
    pub fn read(map: &Value<'_>) -> Result<Option<Announcement>> {
        let Some(fields) = fields(map)? else { return Ok(None) };
        let read = || -> Result<Announcement> {
            let version: i128 = fields.field("version")?.as_integer().context("version")?;
            ensure!(version == VERSION, "version: expected {VERSION}, got {version}");
            let candidates_max = fields.field("candidates_max")?.as_integer();
            let candidates_max: usize = candidates_max.context("candidates_max")?;
            ensure!(candidates_max > 0, "candidates_max: expected at least 1, got 0");
            Ok(Announcement {
                candidates_max: candidates_max.min(CANDIDATES_MAX),
                digest: text(fields, "digest", NAME_BYTES_MAX)?,
                is_greedy: match optional(fields, "greedy") {
                    None => false,
                    Some(Value::Bool(greedy)) => *greedy,
                    Some(other) => bail!("greedy: expected a boolean, got {}", other.kind()),
                },
                image_size: image_size(fields)?,
                hidden_size: count(fields, "hidden_size")?,
                confidence_size: count(fields, "confidence_size")?,
                action_scale: some(numbers(fields, "action_scale")?),
            })
        };
        read().map(Some).context(KEY)
    }

    /// The value of the key `rever`.
    pub fn value(&self, keys: KeyForm) -> Result<Value<'static>> {
        let mut fields = vec![
            ("version", Value::Integer(VERSION)),
            ("candidates_max", Value::Integer(self.candidates_max as i128)),
            ("greedy", Value::Bool(self.is_greedy)),
        ];
        put_text(&mut fields, "digest", self.digest.as_deref());
        if let Some((height, width)) = self.image_size {
            let sides = [height, width].map(|side| Value::Integer(side as i128));
            fields.push(("image_size", Value::List(sides.to_vec())));
        }
        let counts = [("hidden_size", self.hidden_size), ("confidence_size", self.confidence_size)];
        for (name, count) in counts {
            fields.extend(count.map(|count| (name, Value::Integer(count as i128))));
        }
        put_numbers(
            &mut fields,
            "action_scale",
            self.action_scale.as_deref().unwrap_or_default(),
            keys,
        )?;
        Ok(Value::map(fields))
    }
}

impl Ask {
    /// Reads what a client asks for; `None` if the observation has no such field.
    pub fn read(map: &Value<'_>) -> Result<Option<Ask>> {
        let Some(fields) = fields(map)? else { return Ok(None) };
        let read = || -> Result<Ask> {
            let temperature = number(fields, "temperature")?;
            ensure!(
                temperature.is_none_or(|temperature| temperature >= 0.0),
                "temperature: expected 0 or more, got {temperature:?}"
            );
            let candidates = count(fields, "candidates")?;
            ensure!(
                candidates.is_none_or(|count| (1..=CANDIDATES_MAX).contains(&count)),
                "candidates: expected 1 to {CANDIDATES_MAX}, got {}",
                candidates.unwrap_or_default()
            );
            let seed =
                optional(fields, "seed").map(Value::as_integer).transpose().context("seed")?;
            Ok(Ask {
                candidates,
                temperature,
                seed,
                episode: text(fields, "episode", NAME_BYTES_MAX)?,
            })
        };
        read().map(Some).context(KEY)
    }

    /// The value of the key `rever`.
    pub fn value(&self) -> Value<'static> {
        let mut fields = Vec::new();
        fields.extend(self.candidates.map(|count| ("candidates", Value::Integer(count as i128))));
        fields.extend(self.temperature.map(|number| ("temperature", Value::Float(number.into()))));
        fields.extend(self.seed.map(|seed| ("seed", Value::Integer(seed.into()))));
        put_text(&mut fields, "episode", self.episode.as_deref());
        Value::map(fields)
    }
}

impl Answer {
    /// Reads the fields of a reply; `None` if it has none.
    pub fn read(map: &Value<'_>) -> Result<Option<Answer>> {
        let Some(fields) = fields(map)? else { return Ok(None) };
        Answer::of(fields).map(Some).context(KEY)
    }

    fn of(fields: &Value<'_>) -> Result<Answer> {
        let list = match optional(fields, "candidates") {
            None => &[][..],
            Some(Value::List(list)) => list,
            Some(other) => bail!("candidates: expected a list, got {}", other.kind()),
        };
        let count_got = list.len();
        ensure!(
            count_got <= CANDIDATES_MAX,
            "candidates: expected at most {CANDIDATES_MAX}, got {count_got}"
        );
        let read = |(index, value)| {
            AnswerCandidate::read(value).with_context(|| format!("candidate {index}"))
        };
        let candidates = list.iter().enumerate().map(read).collect::<Result<Vec<_>>>()?;
        let chosen: Option<usize> =
            optional(fields, "chosen").map(Value::as_integer).transpose().context("chosen")?;
        ensure!(
            chosen.is_none_or(|index| index < candidates.len()),
            "chosen: expected the index of one of {count_got} candidates, got {chosen:?}"
        );
        Ok(Answer { chosen, candidates, digest: text(fields, "digest", NAME_BYTES_MAX)? })
    }

    /// The value of the key `rever`.
    pub fn value(&self, keys: KeyForm) -> Result<Value<'static>> {
        let chosen = self.chosen.map_or(Value::Nil, |index| Value::Integer(index as i128));
        let candidates = self.candidates.iter().map(|candidate| candidate.value(keys));
        let candidates = Value::List(candidates.collect::<Result<_>>()?);
        let mut fields = vec![("chosen", chosen), ("candidates", candidates)];
        put_text(&mut fields, "digest", self.digest.as_deref());
        Ok(Value::map(fields))
    }
}

impl AnswerCandidate {
    fn read(fields: &Value<'_>) -> Result<AnswerCandidate> {
        fields.entries()?;
        let malformed = text(fields, "malformed", REASONING_BYTES_MAX)?;
        let actions = match optional(fields, "actions") {
            None => Vec::new(),
            Some(value) => actions::actions(value)?,
        };
        ensure!(
            actions.is_empty() == malformed.is_some(),
            "expected either actions or the reason why it is malformed"
        );
        Ok(AnswerCandidate {
            actions,
            reasoning: text(fields, "reasoning", REASONING_BYTES_MAX)?,
            malformed: malformed.map(|reason| printable(&reason)),
            score: number(fields, "score")?,
            tokens: integers(fields, "tokens")?,
            action_tokens: integers(fields, "action_tokens")?,
            log_probability: number(fields, "log_probability")?,
            log_probabilities: numbers(fields, "log_probabilities")?,
            confidence: numbers(fields, "confidence")?,
            hidden: numbers(fields, "hidden")?,
        })
    }

    fn value(&self, keys: KeyForm) -> Result<Value<'static>> {
        let mut fields = Vec::new();
        if !self.actions.is_empty() {
            fields.push(("actions", actions::actions_array(&self.actions)?.into_value(keys)));
        }
        put_text(&mut fields, "reasoning", self.reasoning.as_deref());
        put_text(&mut fields, "malformed", self.malformed.as_deref());
        let numbers = [("score", self.score), ("log_probability", self.log_probability)];
        for (name, number) in numbers {
            fields.extend(number.map(|number| (name, Value::Float(number.into()))));
        }
        for (name, tokens) in [("tokens", &self.tokens), ("action_tokens", &self.action_tokens)] {
            if !tokens.is_empty() {
                fields.push((name, Array::of_u32(tokens)?.into_value(keys)));
            }
        }
        put_numbers(&mut fields, "log_probabilities", &self.log_probabilities, keys)?;
        put_numbers(&mut fields, "confidence", &self.confidence, keys)?;
        put_numbers(&mut fields, "hidden", &self.hidden, keys)?;
        Ok(Value::map(fields))
    }
}

fn put_text(
    fields: &mut Vec<(&'static str, Value<'static>)>,
    name: &'static str,
    text: Option<&str>,
) {
    fields.extend(text.map(|text| (name, Value::Text(text.to_owned().into()))));
}

fn put_numbers(
    fields: &mut Vec<(&'static str, Value<'static>)>,
    name: &'static str,
    numbers: &[f32],
    keys: KeyForm,
) -> Result<()> {
    if !numbers.is_empty() {
        fields.push((name, Array::of_f32(vec![numbers.len()], numbers)?.into_value(keys)));
    }
    Ok(())
}

/// A field that may be missing or nil.
fn optional<'a, 'b>(fields: &'b Value<'a>, name: &str) -> Option<&'b Value<'a>> {
    fields.get(name).filter(|value| **value != Value::Nil)
}

fn text(fields: &Value<'_>, name: &'static str, bytes_max: usize) -> Result<Option<String>> {
    let Some(value) = optional(fields, name) else { return Ok(None) };
    let text = value.as_text().context(name)?;
    let bytes = text.len();
    ensure!(bytes <= bytes_max, "{name}: expected at most {bytes_max} bytes, got {bytes}");
    Ok(Some(text.to_owned()))
}

fn count(fields: &Value<'_>, name: &'static str) -> Result<Option<usize>> {
    let Some(value) = optional(fields, name) else { return Ok(None) };
    let count: usize = value.as_integer().context(name)?;
    ensure!(count <= NUMBERS_MAX, "{name}: expected at most {NUMBERS_MAX}, got {count}");
    Ok(Some(count))
}

fn image_size(fields: &Value<'_>) -> Result<Option<(usize, usize)>> {
    let Some(value) = optional(fields, "image_size") else { return Ok(None) };
    let sides = match value {
        Value::List(sides) => sides.iter().map(Value::as_integer).collect::<Result<Vec<usize>>>(),
        other => bail!("image_size: expected a list, got {}", other.kind()),
    };
    let sides = sides.context("image_size")?;
    match sides[..] {
        [height, width] if sides.iter().all(|side| (1..=IMAGE_SIDE_MAX).contains(side)) => {
            Ok(Some((height, width)))
        }
        _ => bail!("image_size: expected two numbers from 1 to {IMAGE_SIDE_MAX}, got {sides:?}"),
    }
}

fn number(fields: &Value<'_>, name: &'static str) -> Result<Option<f32>> {
    let Some(value) = optional(fields, name) else { return Ok(None) };
    let number = value.as_number().context(name)? as f32;
    ensure!(number.is_finite(), "{name}: expected a finite number, got {number}");
    Ok(Some(number))
}

fn list<'a>(fields: &'a Value<'_>, name: &'static str) -> Result<Option<Array<'a>>> {
    let Some(value) = optional(fields, name) else { return Ok(None) };
    let array = Array::from_value(value).context(name)?;
    let length: usize = array.shape.iter().product();
    ensure!(length <= NUMBERS_MAX, "{name}: expected at most {NUMBERS_MAX} numbers, got {length}");
    Ok(Some(array))
}

fn numbers(fields: &Value<'_>, name: &'static str) -> Result<Vec<f32>> {
    let numbers = list(fields, name)?.map(|array| array.to_f32()).unwrap_or_default();
    ensure!(numbers.iter().all(|number| number.is_finite()), "{name}: expected finite numbers");
    Ok(numbers)
}

fn integers(fields: &Value<'_>, name: &'static str) -> Result<Vec<u32>> {
    match list(fields, name)? {
        Some(array) if !array.shape.contains(&0) => array.to_u32().context(name),
        _ => Ok(Vec::new()),
    }
}

fn some(numbers: Vec<f32>) -> Option<Vec<f32>> {
    (!numbers.is_empty()).then_some(numbers)
}
