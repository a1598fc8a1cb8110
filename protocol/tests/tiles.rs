//! Images sent as changed tiles.

use protocol::{Image, encode};

use crate::examples;
use crate::refused::{Case, case, changed};

/// An image in which every byte differs from its neighbours.
fn image(height: usize, width: usize) -> Image {
    Image { height, width, pixels: (0..height * width * 3).map(|at| (at % 251) as u8).collect() }
}

/// The image with other values at these offsets.
fn with(image: &Image, places: &[usize]) -> Image {
    let mut pixels = image.pixels.to_vec();
    for &place in places {
        pixels[place] ^= 0x80;
    }
    Image { pixels: pixels.into(), ..image.clone() }
}

fn sent(last: &Image, next: &Image) -> (Vec<u32>, usize, Image) {
    let (tiles, pixels) = next.changes(last).expect("less than half is new");
    let bytes = pixels.len();
    let mut image = Image { pixels, ..next.clone() };
    image.complete(&tiles, last.clone()).expect("the same size");
    (tiles, bytes, image)
}

#[test]
fn changed_tiles_restore_the_complete_image() {
    let last = image(32, 48);
    // A row has 144 bytes, 48 of them per tile. Changed are the corners of the middle tile of the
    // upper row, and the last byte of the image.
    let corners = [48, 95, 15 * 144 + 48, 15 * 144 + 95, 32 * 144 - 1];
    let next = with(&last, &corners);
    assert_eq!(sent(&last, &next), (vec![1, 5], 2 * 768, next.clone()));
    for place in 0..last.pixels.len() {
        let next = with(&last, &[place]);
        let tile = place / 144 / 16 * 3 + place % 144 / 48;
        assert_eq!(sent(&last, &next), (vec![tile as u32], 768, next.clone()), "byte {place}");
    }
    assert_eq!(sent(&last, &last), (vec![], 0, last.clone()));
}

#[test]
fn an_image_that_is_shared_is_not_modified() {
    let last = image(32, 48);
    let next = with(&last, &[100]);
    let (tiles, pixels) = next.changes(&last).expect("one tile is new");
    let held = last.clone();
    let mut shared = Image { pixels: pixels.clone(), ..next.clone() };
    shared.complete(&tiles, last).expect("the same size");
    assert_eq!((shared, &held), (next.clone(), &image(32, 48)));
    let place = held.pixels.as_ptr();
    let mut alone = Image { pixels, ..next.clone() };
    alone.complete(&tiles, held).expect("the same size");
    assert_eq!(alone, next);
    assert_eq!(alone.pixels.as_ptr(), place, "it was copied");
}

#[test]
fn an_image_is_sent_whole_if_tiles_cannot_represent_it() {
    let last = image(32, 48);
    assert_eq!(with(&last, &[0, 48, 96]).changes(&last).map(|(tiles, _)| tiles.len()), Some(3));
    assert_eq!(with(&last, &[0, 48, 96, 4607]).changes(&last), None, "more than half is new");
    assert_eq!(image(48, 32).changes(&last), None, "another size");
    assert_eq!(image(15, 48).changes(&image(15, 48)), None, "a side is cut");
    assert_eq!(image(0, 0).changes(&image(0, 0)), None, "no image");
}

#[test]
fn tiles_of_an_image_of_another_size_are_refused() {
    let error = image(32, 48).complete(&[], image(48, 32));
    let words = "changed_tiles: expected an image of 48 x 32 pixels as before, got 32 x 48";
    assert_eq!(error, Err(words.to_owned()));
}

/// Encodings that must be refused.
pub fn cases() -> Vec<Case> {
    let stepped = || encode(&examples::replies()[7].1).expect("examples are valid");
    let numbered = |numbers: &[u8]| {
        let list = [&[0x90 | numbers.len() as u8], numbers].concat();
        changed(stepped(), b"changed_tiles\x91\x01", &[b"changed_tiles", &list[..]].concat())
    };
    vec![
        case(
            "tiles_cut",
            "reply",
            changed(stepped(), b"height\x10", b"height\x0f"),
            "changed_tiles: expected sides that are multiples of 16, got 15 x 48",
        ),
        case("tiles_beyond", "reply", numbered(&[3]), "changed_tiles: expected 0 to 2, got 3"),
        case(
            "tiles_twice",
            "reply",
            numbered(&[1, 1]),
            "changed_tiles: expected ascending numbers, got 1 before 1",
        ),
        case(
            "tiles_bytes",
            "reply",
            numbered(&[0, 1]),
            "image: expected 1536 bytes for 2 tiles, got 768",
        ),
    ]
}
