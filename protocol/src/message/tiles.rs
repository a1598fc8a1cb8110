//! Delta encoding of a step's image: only the tiles that changed are sent. A fixed camera repeats
//! most of the previous image.

use bytes::{Bytes, BytesMut};

use super::Image;
use crate::limits::TILE_SIDE;

/// Bytes in one row of a tile, and in a tile.
const ROW: usize = TILE_SIDE * 3;
const TILE: usize = TILE_SIDE * ROW;

impl Image {
    /// The tiles in which this image differs from `last`, in ascending order, and their pixels.
    /// `None` if the whole image should be sent: `last` has another size, a side is not a multiple
    /// of a tile's side, or more than half of the tiles changed.
    pub fn changes(&self, last: &Image) -> Option<(Vec<u32>, Bytes)> {
        let count = self.tiles()?;
        if (self.height, self.width) != (last.height, last.width) {
            return None;
        }
        let tiles = self.differing(last);
        if tiles.len() > count / 2 {
            return None;
        }
        let mut pixels = Vec::with_capacity(tiles.len() * TILE);
        for at in tiles.iter().flat_map(|tile| self.rows(*tile)) {
            pixels.extend_from_slice(&self.pixels[at..][..ROW]);
        }
        Some((tiles, pixels.into()))
    }

    /// Numbers of the tiles that differ between two images of the same size.
    fn differing(&self, last: &Image) -> Vec<u32> {
        let line = self.width * 3;
        let bands = self.pixels.chunks_exact(TILE_SIDE * line);
        let mut tiles = Vec::new();
        let mut number = 0;
        let mut differs = vec![0; line];
        for (new, old) in bands.zip(last.pixels.chunks_exact(TILE_SIDE * line)) {
            // Whole lines in memory order, which the compiler can vectorise.
            differs.fill(0);
            for (new, old) in new.chunks_exact(line).zip(old.chunks_exact(line)) {
                for ((differs, new), old) in differs.iter_mut().zip(new).zip(old) {
                    *differs |= new ^ old;
                }
            }
            for bits in differs.chunks_exact(ROW) {
                if bits.iter().any(|bits| *bits != 0) {
                    tiles.push(number);
                }
                number += 1;
            }
        }
        tiles
    }

    /// Replaces the tiles of a valid [`crate::Reply::Stepped`] by the complete image. Overwrites
    /// `last` in place if nothing else holds its pixels.
    pub fn complete(&mut self, tiles: &[u32], last: Image) -> Result<(), String> {
        let (expected, got) = ((last.height, last.width), (self.height, self.width));
        if got != expected {
            return Err(format!(
                "changed_tiles: expected an image of {} x {} pixels as before, got {} x {}",
                expected.0, expected.1, got.0, got.1
            ));
        }
        let mut pixels =
            last.pixels.try_into_mut().unwrap_or_else(|shared| BytesMut::from(&shared[..]));
        let places = tiles.iter().flat_map(|tile| self.rows(*tile));
        for (at, row) in places.zip(self.pixels.chunks_exact(ROW)) {
            pixels[at..][..ROW].copy_from_slice(row);
        }
        self.pixels = pixels.freeze();
        Ok(())
    }

    /// Checks that the numbers and the bytes of the tiles fit the size of the image.
    pub(super) fn validate_tiles(&self, tiles: &[u32]) -> Result<(), String> {
        self.validate_sides()?;
        let count = self.tiles().ok_or_else(|| {
            format!(
                "changed_tiles: expected sides that are multiples of {TILE_SIDE}, got {} x {}",
                self.height, self.width
            )
        })?;
        if let Some(tile) = tiles.iter().find(|tile| **tile as usize >= count) {
            return Err(format!("changed_tiles: expected 0 to {}, got {tile}", count - 1));
        }
        if let Some(pair) = tiles.windows(2).find(|pair| pair[0] >= pair[1]) {
            return Err(format!(
                "changed_tiles: expected ascending numbers, got {} before {}",
                pair[0], pair[1]
            ));
        }
        let (expected, got) = (tiles.len() * TILE, self.pixels.len());
        if got != expected {
            return Err(format!(
                "image: expected {expected} bytes for {} tiles, got {got}",
                tiles.len()
            ));
        }
        Ok(())
    }

    /// Number of tiles in the complete image; `None` if a side is not a multiple of a tile's side.
    fn tiles(&self) -> Option<usize> {
        let whole = self.height.is_multiple_of(TILE_SIDE) && self.width.is_multiple_of(TILE_SIDE);
        let count = (self.height / TILE_SIDE) * (self.width / TILE_SIDE);
        (whole && count > 0).then_some(count)
    }

    /// Offsets of the rows of a tile in the complete image.
    fn rows(&self, tile: u32) -> impl Iterator<Item = usize> + use<> {
        let (line, across) = (self.width * 3, self.width / TILE_SIDE);
        let first = tile as usize / across * TILE_SIDE * line + tile as usize % across * ROW;
        (0..TILE_SIDE).map(move |row| first + row * line)
    }
}
