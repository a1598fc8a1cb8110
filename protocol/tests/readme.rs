//! Compares the specification in README.md with the types: fields and their kinds, limits, keys.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use protocol::{Keys, Message, encode, limits};
use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};

use crate::examples;

/// The structure of an encoded message, with its fields in order.
#[derive(Debug, Clone, PartialEq)]
enum Shape {
    Fields(Vec<(String, Shape)>),
    Elements(Vec<Shape>),
    Plain(&'static str),
}

impl<'de> Deserialize<'de> for Shape {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Shape, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Shape;
            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("anything")
            }
            fn visit_bool<E>(self, _: bool) -> Result<Shape, E> {
                Ok(Shape::Plain("bool"))
            }
            fn visit_u64<E>(self, _: u64) -> Result<Shape, E> {
                Ok(Shape::Plain("unsigned"))
            }
            fn visit_f32<E>(self, _: f32) -> Result<Shape, E> {
                Ok(Shape::Plain("f32"))
            }
            fn visit_str<E>(self, _: &str) -> Result<Shape, E> {
                Ok(Shape::Plain("text"))
            }
            fn visit_bytes<E>(self, _: &[u8]) -> Result<Shape, E> {
                Ok(Shape::Plain("bytes"))
            }
            fn visit_unit<E>(self) -> Result<Shape, E> {
                Ok(Shape::Plain("nil"))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Shape, A::Error> {
                let mut elements = Vec::new();
                while let Some(element) = seq.next_element()? {
                    elements.push(element);
                }
                Ok(Shape::Elements(elements))
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Shape, A::Error> {
                let mut fields = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    fields.push(entry);
                }
                Ok(Shape::Fields(fields))
            }
        }
        deserializer.deserialize_any(Any)
    }
}

/// For each type in the README: its fields and their kinds.
type Types = BTreeMap<String, Vec<(String, String)>>;

fn readme() -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("README.md");
    std::fs::read_to_string(path).expect("there is a README")
}

fn types(readme: &str) -> Types {
    let section = readme.split("## Messages").nth(1).expect("a section");
    let block = section.split("```").nth(1).expect("a block");
    let mut types = Types::new();
    let mut name = String::new();
    for line in block.lines().filter(|line| !line.trim().is_empty()) {
        let mut fields = line;
        if !line.starts_with(' ') {
            let (first, rest) = line.split_once(' ').expect("a name and fields");
            (name, fields) = (first.to_owned(), rest);
        }
        let fields = fields.split(", ").map(|field| field.trim().trim_end_matches(','));
        for field in fields.filter(|field| !field.is_empty() && !field.contains('|')) {
            let (field, kind) = field.split_once(' ').expect("a field and its kind");
            types.entry(name.clone()).or_default().push((field.to_owned(), kind.to_owned()));
        }
    }
    types
}

/// Compares an encoded message with the README's types, and adds the types that occur to `met`.
fn compare(types: &Types, name: &str, shape: &Shape, met: &mut Vec<String>) {
    let Shape::Fields(fields) = shape else { panic!("{name}: expected fields, got {shape:?}") };
    let said = types.get(name).unwrap_or_else(|| panic!("the README does not describe {name}"));
    let names = |fields: Vec<&String>| fields.into_iter().cloned().collect::<Vec<_>>();
    let (expected, got) = (
        names(fields.iter().map(|(field, _)| field).collect()),
        names(said.iter().map(|(field, _)| field).collect()),
    );
    assert_eq!(got, expected, "fields of {name}");
    met.push(name.to_owned());
    for ((field, value), (_, kind)) in fields.iter().zip(said) {
        compare_kind(types, &format!("{name}.{field}"), kind, value, met);
    }
}

fn compare_kind(types: &Types, place: &str, kind: &str, value: &Shape, met: &mut Vec<String>) {
    let optional = kind.strip_suffix('?');
    let inner =
        kind.strip_prefix('[').and_then(|kind| kind.trim_end_matches('?').strip_suffix(']'));
    let fits = match (value, inner) {
        (Shape::Plain("nil"), _) => optional.is_some(),
        (Shape::Elements(elements), Some(inner)) => {
            let (of, count) = inner.split_once("; ").unwrap_or((inner, ""));
            elements.iter().for_each(|element| compare_kind(types, place, of, element, met));
            count.is_empty() || count == elements.len().to_string()
        }
        (Shape::Fields(_), None) => {
            compare(types, kind, value, met);
            true
        }
        (Shape::Plain("unsigned"), None) => matches!(optional.unwrap_or(kind), "u32" | "u64"),
        (Shape::Plain("text"), None) => matches!(optional.unwrap_or(kind), "text" | "FaultKind"),
        (Shape::Plain(plain), None) => optional.unwrap_or(kind) == *plain,
        _ => false,
    };
    assert!(fits, "{place}: the README says {kind}, the bytes hold {value:?}");
}

fn shape<M: Message>(message: &M) -> Shape {
    rmp_serde::from_slice(&encode(message).expect("examples are valid")).expect("it is MessagePack")
}

#[test]
fn the_readme_names_every_field_of_every_message() {
    let types = types(&readme());
    let mut met = Vec::new();
    let mut whole = |name: &str, shape: Shape| compare(&types, name, &shape, &mut met);
    whole("Description", shape(&examples::description()));
    whole("Open", shape(&examples::open()));
    whole("Heartbeat", shape(&examples::heartbeat()));
    whole("EpisodeOutcome", shape(&examples::outcome()));
    whole("VerifierUpdate", shape(&examples::verifier_update()));
    let openings = examples::openings().map(|(_, opening)| ("Opening", shape(&opening)));
    let requests = examples::requests().map(|(_, request)| ("Request", shape(&request)));
    let replies = examples::replies().map(|(_, reply)| ("Reply", shape(&reply)));
    for (of, shape) in openings.into_iter().chain(requests).chain(replies) {
        let Shape::Fields(variants) = shape else { panic!("{of}: expected a map of one variant") };
        let [(variant, fields)] = &variants[..] else { panic!("{of}: expected one variant") };
        whole(&format!("{of}::{variant}"), fields.clone());
    }
    let unknown: Vec<&String> = types.keys().filter(|name| !met.contains(name)).collect();
    assert!(unknown.is_empty(), "the README describes types that no message contains: {unknown:?}");
}

#[test]
fn the_readme_states_every_limit() {
    let found = readme().split_whitespace().collect::<Vec<_>>().join(" ");
    let kib = |bytes: usize| format!("{} KiB", bytes >> 10);
    let mib = |bytes: usize| format!("{} MiB", bytes >> 20);
    for sentence in [
        format!("request, open {}", kib(limits::REQUEST_BYTES_MAX)),
        format!("reply {}", mib(limits::REPLY_BYTES_MAX)),
        format!("opening, outcome {}", kib(limits::OPENING_BYTES_MAX)),
        format!("description {}", kib(limits::DESCRIPTION_BYTES_MAX)),
        format!("heartbeat {} B", limits::HEARTBEAT_BYTES_MAX),
        format!("verifier update {}", mib(limits::VERIFIER_UPDATE_BYTES_MAX)),
        format!("nesting {}; {} elements", limits::DEPTH_MAX, limits::ELEMENTS_MAX),
        format!("Names are 1 to {} bytes without control characters", limits::NAME_BYTES_MAX),
        format!("texts up to {}", limits::TEXT_BYTES_MAX),
        format!("image sides 1 to {}, or 0 x 0", limits::IMAGE_SIDE_MAX),
        format!("slots 0 to {}", limits::SLOTS_MAX - 1),
        format!("seeds below 2^{}", limits::SEED_END.ilog2()),
        format!(
            "an action has 1 to {} numbers, a state up to {}",
            limits::ACTION_DIMENSIONS_MAX,
            limits::STATE_DIMENSIONS_MAX
        ),
    ] {
        assert!(found.contains(&sentence), "the README does not say: {sentence}");
    }
    assert_eq!(limits::OPEN_BYTES_MAX, limits::REQUEST_BYTES_MAX);
    assert_eq!(limits::OUTCOME_BYTES_MAX, limits::OPENING_BYTES_MAX);
}

#[test]
fn the_readme_lists_every_key() {
    let readme = readme();
    let keys = Keys::new("FLEET").expect("a fleet");
    let made = [
        keys.server("SERVER"),
        keys.describe("SERVER"),
        keys.open("SERVER"),
        keys.heartbeat("SERVER"),
        keys.session("SESSION"),
        keys.request("SESSION"),
        keys.reply("SESSION"),
        keys.outcome("RUN"),
        keys.verifier("NAME"),
    ];
    let section = readme.split("## Keys").nth(1).expect("a section");
    for key in &made {
        let key = key.as_ref().expect("names that may stand in keys");
        let key = key.strip_prefix("rever/3/FLEET/").expect("the prefix of the README");
        let parts = key.split('/').map(|part| match part {
            "SERVER" | "SESSION" | "RUN" | "NAME" => format!("{{{}}}", part.to_lowercase()),
            part => part.to_owned(),
        });
        let row = format!("| `{}` |", parts.collect::<Vec<_>>().join("/"));
        assert!(section.contains(&row), "the README's table of keys has no row {row}");
    }
    let rows = section.lines().filter(|line| line.starts_with("| `")).count();
    assert_eq!(rows, made.len(), "rows of the README's table of keys");
}
