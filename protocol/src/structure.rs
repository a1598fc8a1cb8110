//! The structure of raw MessagePack bytes, checked before anything is decoded or allocated from them.

use std::fmt;
use std::ops::Range;

use crate::limits::{DEPTH_MAX, ELEMENTS_MAX};

/// How many values of each type there are; equal messages have equal shapes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Shape {
    maps: usize,
    arrays: usize,
    texts: usize,
    bytes: usize,
    integers: usize,
    floats: usize,
    booleans: usize,
    nils: usize,
}

/// What a check tells of bytes that it accepts.
#[derive(Debug)]
pub struct Structure {
    /// Of the whole.
    pub shape: Shape,
    /// The last value of bytes, if there is one; no message has two.
    pub bulk: Option<Bulk>,
}

/// Where a value of bytes lies.
#[derive(Debug)]
pub struct Bulk {
    /// Its marker.
    pub start: usize,
    /// Behind marker and length.
    pub content: Range<usize>,
}

/// Accepts exactly one value made of maps with text keys, arrays, text, bytes, integers, 32-bit floats, booleans and
/// nil, each in its shortest form, nested and counted within the limits.
pub fn check(bytes: &[u8]) -> Result<Structure, String> {
    let mut reader = Reader { bytes, position: 0, shape: Shape::default(), bulk: None };
    reader.value(1)?;
    match bytes.len() - reader.position {
        0 => Ok(Structure { shape: reader.shape, bulk: reader.bulk }),
        rest => {
            Err(format!("expected the end after byte {}, got {rest} more bytes", reader.position))
        }
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
    position: usize,
    shape: Shape,
    bulk: Option<Bulk>,
}

impl Reader<'_> {
    fn value(&mut self, depth: usize) -> Result<(), String> {
        if depth > DEPTH_MAX {
            return Err(format!("maps and arrays are nested deeper than {DEPTH_MAX}"));
        }
        let start = self.position;
        let marker = self.unsigned(1)? as u8;
        match marker {
            0x00..=0x7f | 0xe0..=0xff => self.shape.integers += 1,
            0xc0 => self.shape.nils += 1,
            0xc2 | 0xc3 => self.shape.booleans += 1,
            0x80..=0x8f => self.map((marker & 0x0f).into(), depth)?,
            0x90..=0x9f => self.array((marker & 0x0f).into(), depth)?,
            0xa0..=0xbf => self.text((marker & 0x1f).into())?,
            0xc4..=0xc6 => {
                let length = self.header(1 << (marker - 0xc4), 1, 0, start)?;
                self.shape.bytes += 1;
                let content = self.position;
                self.skip(length)?;
                self.bulk = Some(Bulk { start, content: content..self.position });
            }
            0xca => {
                self.shape.floats += 1;
                self.skip(4)?;
            }
            0xcb => {
                return Err(format!("expected 32-bit floats, got a 64-bit float at byte {start}"));
            }
            0xcc..=0xcf => {
                self.header(1 << (marker - 0xcc), 1, 0x80, start)?;
                self.shape.integers += 1;
            }
            0xd0..=0xd3 => {
                return Err(format!(
                    "expected unsigned integers, got a signed one at byte {start}"
                ));
            }
            0xd9..=0xdb => {
                let length = self.header(1 << (marker - 0xd9), 1, 0x20, start)?;
                self.text(length)?;
            }
            0xdc | 0xdd => {
                let length = self.header(2 << (marker - 0xdc), 2, 0x10, start)?;
                self.array(length, depth)?;
            }
            0xde | 0xdf => {
                let length = self.header(2 << (marker - 0xde), 2, 0x10, start)?;
                self.map(length, depth)?;
            }
            0xc1 | 0xc7..=0xc9 | 0xd4..=0xd8 => {
                return Err(format!(
                    "expected no reserved or extension type, got {marker:#04x} at byte {start}"
                ));
            }
        }
        Ok(())
    }

    fn text(&mut self, length: usize) -> Result<(), String> {
        self.shape.texts += 1;
        self.skip(length)
    }

    fn array(&mut self, length: usize, depth: usize) -> Result<(), String> {
        check_elements(length)?;
        self.shape.arrays += 1;
        (0..length).try_for_each(|_| self.value(depth + 1))
    }

    fn map(&mut self, length: usize, depth: usize) -> Result<(), String> {
        check_elements(length)?;
        self.shape.maps += 1;
        for _ in 0..length {
            match self.bytes.get(self.position) {
                Some(0xa0..=0xbf | 0xd9..=0xdb) | None => self.value(depth + 1)?,
                Some(_) => {
                    return Err(format!(
                        "expected text as a map's key, got another type at byte {}",
                        self.position
                    ));
                }
            }
            self.value(depth + 1)?;
        }
        Ok(())
    }

    /// The big-endian number behind a marker, in `width` of the widths `first`, twice that and so
    /// on; refused when a narrower one, or the marker itself below `fixed`, would have held it.
    fn header(
        &mut self,
        width: usize,
        first: usize,
        fixed: u64,
        start: usize,
    ) -> Result<usize, String> {
        let number = self.unsigned(width)?;
        let least = if width == first { fixed } else { 1 << (4 * width) };
        if number < least {
            return Err(format!(
                "expected the shortest form of a value, got a longer one at byte {start}"
            ));
        }
        Ok(number as usize)
    }

    fn unsigned(&mut self, width: usize) -> Result<u64, String> {
        let start = self.position;
        self.skip(width)?;
        Ok(self.bytes[start..self.position]
            .iter()
            .fold(0, |number, byte| number << 8 | u64::from(*byte)))
    }

    fn skip(&mut self, length: usize) -> Result<(), String> {
        if length > self.bytes.len() - self.position {
            return Err(format!(
                "expected more bytes, got the end after byte {}",
                self.bytes.len()
            ));
        }
        self.position += length;
        Ok(())
    }
}

fn check_elements(length: usize) -> Result<(), String> {
    if length > ELEMENTS_MAX {
        return Err(format!("expected at most {ELEMENTS_MAX} elements, got {length}"));
    }
    Ok(())
}

impl fmt::Display for Shape {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Shape { maps, arrays, texts, bytes, integers, floats, booleans, nils } = self;
        write!(
            formatter,
            "{maps} maps {arrays} arrays {texts} texts {bytes} bytes {integers} integers {floats} floats \
             {booleans} booleans {nils} nils"
        )
    }
}
