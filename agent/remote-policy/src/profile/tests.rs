//! Profiles that come with the program, and profiles to refuse.

use decision::Image;

use super::file::NAMES;
use super::{Answers, Profile, Rotation, StateValue};
use crate::Wire;

fn profile(name: &str) -> Profile {
    Profile::load(name).expect(name)
}

/// The profile `bridge` with one text replaced by another.
fn changed(from: &str, to: &str) -> anyhow::Result<Profile> {
    let text = include_str!("../../profiles/bridge.toml");
    assert!(text.contains(from), "{from}");
    Profile::parse(&text.replacen(from, to, 1))
}

#[test]
fn every_profile_works_on_every_wire() {
    for name in NAMES {
        for wire in [Wire::OpenPi, Wire::VlaEval, Wire::Act] {
            profile(name).check_wire(wire).expect(name);
        }
        assert_eq!(profile(name).server.answers, Answers::Sampled);
    }
    let digests: std::collections::HashSet<String> =
        NAMES.iter().map(|name| profile(name).digest().expect("a digest")).collect();
    assert_eq!(digests.len(), NAMES.len());
}

#[test]
fn unknown_fields_and_names_are_refused_with_a_suggestion() {
    let error = format!("{:#}", changed("rotation =", "rotaton =").expect_err("refused"));
    assert!(
        error.contains("unknown field `rotaton`") && error.ends_with("did you mean rotation?"),
        "{error}"
    );
    let error =
        format!("{:#}", changed("\"gripper-open\"", "\"gripper-opne\"").expect_err("refused"));
    assert!(error.ends_with("did you mean gripper-open?"), "{error}");
    let error = format!("{:#}", Profile::load("bridgw").expect_err("refused"));
    assert_eq!(
        error,
        "profile bridgw: expected one of bridge, libero, rever, simpler or a file, got neither; did you mean bridge?"
    );
}

#[test]
fn numbers_that_do_not_fit_together_are_refused() {
    for (from, to, expected) in [
        ("dimensions = 7", "dimensions = 0", "actions.dimensions: expected 1 to 64, got 0"),
        ("dimensions = 7", "dimensions = 8", "actions.scale: expected 8 numbers, got 7"),
        ("execute = 4", "execute = 0", "actions.execute: expected 1 to 1024, got 0"),
        ("closed = 0.0", "closed = 1.0", "actions.gripper: expected two numbers, got 1 and 1"),
        (
            "height = 224",
            "height = 4096",
            "camera: expected sides of 1 to 2048 pixels, got 4096 x 224",
        ),
        (
            "\"x\", ",
            "\"x\", \"all\", ",
            "state.values: expected \"all\" to stand alone, got 8 values",
        ),
        ("scale = [0.05704", "scale = [-1.0", "actions.scale: expected numbers of at least 0"),
    ] {
        let error = format!("{:#}", changed(from, to).expect_err(expected));
        assert_eq!(error, expected);
    }
    let mut other = profile("bridge");
    other.prompt.names.act = None;
    let error = other.check_wire(Wire::Act).expect_err("refused").to_string();
    assert_eq!(error, "prompt: expected a name on the wire http, got none; add one to the profile");
}

/// One action of a server by each profile.
#[test]
fn actions_are_mapped_to_metres_rotation_vectors_and_open_positive_grippers() {
    let action = |name: &str, gripper: f32| {
        let received = vec![vec![0.5, -1.0, 0.0, 0.0, 0.0, 0.5, gripper]];
        profile(name).actions.chunk(&received).expect(name).first().to_vec()
    };
    assert_eq!(action("simpler", 0.6), [0.5, -1.0, 0.0, 0.0, 0.0, 0.5, 1.0]);
    assert_eq!(action("simpler", 0.5)[6], -1.0, "above 0.5 opens");
    assert_eq!(action("rever", -1.0)[6], -1.0);
    // A turn about one axis is the same in both descriptions.
    assert_eq!(action("bridge", 1.0), [0.5, -1.0, 0.0, 0.0, 0.0, 0.5, 1.0]);
    assert_eq!(action("libero", -1.0), [0.025, -0.05, 0.0, 0.0, 0.0, 0.25, 1.0]);
    assert_eq!(action("libero", 1.0)[6], -1.0);
    let mut bridge = profile("bridge");
    let turned = vec![vec![0.0, 0.0, 0.0, 0.3, 0.2, 0.1, 0.0]];
    let vector = bridge.actions.chunk(&turned).expect("a chunk").first().to_vec();
    let expected =
        decision::rotation_vector(f64::from(0.3_f32), f64::from(0.2_f32), f64::from(0.1_f32));
    assert_eq!(vector[3..6], expected.map(|number| number as f32));
    assert!((vector[3] - 0.3).abs() > 1e-3, "Euler angles are no rotation vector");
    bridge.actions.rotation = Rotation::Vector;
    assert_eq!(bridge.actions.chunk(&turned).expect("a chunk").first()[3..6], [0.3, 0.2, 0.1]);
}

#[test]
fn a_chunk_is_cut_and_padding_is_dropped() {
    let bridge = profile("bridge");
    let padded: Vec<Vec<f32>> =
        (0..10).map(|step| [vec![step as f32; 7], vec![9.0; 25]].concat()).collect();
    let chunk = bridge.actions.chunk(&padded).expect("a chunk");
    assert_eq!((chunk.actions().len(), chunk.action_length()), (4, 7));
    let error = bridge.actions.chunk(&[vec![0.0; 6]]).expect_err("refused").to_string();
    assert_eq!(error, "actions: expected 7 dimensions, got 6");
}

#[test]
fn states_are_computed_from_a_bridge_state() {
    let state = [0.1, 0.2, 0.3, 0.0, 0.0, std::f32::consts::FRAC_PI_2, 0.0, 0.5];
    let numbers = |name: &str| {
        let input = profile(name).state.expect("a state");
        input.numbers(&state).expect(name)
    };
    assert_eq!(numbers("bridge"), [0.1, 0.2, 0.3, 0.0, 0.0, state[5], 0.5]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    for (got, expected) in numbers("simpler").iter().zip([0.1, 0.2, 0.3, half, 0.0, 0.0, half, 0.5])
    {
        assert!((got - expected).abs() < 1e-6, "{got}, expected {expected}");
    }
    for (got, expected) in
        numbers("libero").iter().zip([0.1, 0.2, 0.3, 0.0, 0.0, state[5], 0.02, -0.02])
    {
        assert!((got - expected).abs() < 1e-6, "{got}, expected {expected}");
    }
    let bridge = profile("bridge").state.expect("a state");
    let error = bridge.numbers(&state[..4]).expect_err("refused").to_string();
    assert!(error.starts_with("state: expected the 8 numbers of a Bridge task"), "{error}");
    let mut all = bridge;
    all.values = vec![StateValue::All];
    assert_eq!(all.numbers(&state[..4]).expect("any state"), state[..4]);
}

#[test]
fn images_are_padded_stretched_and_turned() {
    let input = |resize: &str, channels: &str| {
        let text = "resize = \"pad\"\n\n# Forks";
        let with = format!("resize = \"{resize}\"\nchannels = \"{channels}\"\n\n# Forks");
        changed(text, &with).expect("a profile").images.remove(0)
    };
    let wide = Image { height: 112, width: 224, pixels: vec![200; 112 * 224 * 3].into() };
    let padded = input("pad", "last").fit(&wide).expect("an image");
    assert_eq!((padded.height, padded.width), (224, 224));
    let row = |image: &Image, row: usize| image.pixels[row * 224 * 3];
    assert_eq!([0, 55, 56, 167, 168].map(|index| row(&padded, index)), [0, 0, 200, 200, 0]);
    let stretched = input("stretch", "last").fit(&wide).expect("an image");
    assert!(stretched.pixels.iter().all(|pixel| *pixel == 200));
    let refused = input("refuse", "last").fit(&wide).expect_err("refused").to_string();
    assert_eq!(refused, "image: expected 224 x 224 pixels, got 112 x 224");
    let pixels = Image { height: 1, width: 2, pixels: vec![1, 2, 3, 4, 5, 6].into() };
    let first = input("pad", "first").array(&pixels).expect("an array");
    assert_eq!((first.shape.clone(), &*first.bytes), (vec![3, 1, 2], &[1, 4, 2, 5, 3, 6][..]));
    let black = profile("bridge").images[1].fit(&pixels).expect("an image");
    assert!(black.pixels.iter().all(|pixel| *pixel == 0));
}
