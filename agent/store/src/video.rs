//! Videos of episodes: H.264 in an MP4 file that every browser plays, encoded while the episode
//! runs.

use anyhow::{Context, bail, ensure};
use muxide::api::{Muxer, MuxerBuilder, VideoCodec};
use openh264::OpenH264API;
use openh264::encoder::{
    BitRate, Complexity, Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, QpRange,
    RateControlMode, VuiConfig,
};
use openh264::formats::{RgbSliceU8, YUVBuffer};

/// Frames per second: a control step lasts 1/5 s, so videos play in real time.
pub const FRAMES_PER_SECOND: u32 = 5;

/// H.264 halves the resolution of the colour planes, so each pixel is doubled first. A box drawn
/// around a pixel of the model's image then still encloses that pixel's colour. This costs about a
/// third more bytes.
const SCALE: usize = 2;

/// A seek decodes at most this many frames; the report seeks at every key press.
const KEYFRAME_EVERY: u32 = 25;

/// Maximum number of frames: an episode has at most a few hundred steps.
const FRAMES_MAX: usize = 10_000;

/// The video of one episode: frame `k` is the policy's input at step `k`, the last frame shows the
/// result of the last step.
pub struct Video {
    height: usize,
    width: usize,
    encoder: Encoder,
    scaled: Vec<u8>,
    planes: YUVBuffer,
    muxer: Muxer<Vec<u8>>,
    frames: usize,
}

impl Video {
    /// Starts a video of frames with `height` x `width` pixels.
    pub fn new(height: usize, width: usize) -> anyhow::Result<Self> {
        ensure!(
            (8..=1024).contains(&height) && (8..=1024).contains(&width),
            "video frame: expected 8 to 1024 pixels per side, got {height} x {width}"
        );
        // Rate control is off because it would skip frames, and then frame k would not be step k.
        // The fixed quantiser keeps thin grippers sharp at about 0.5 kB per frame.
        let options = EncoderConfig::new()
            .rate_control_mode(RateControlMode::Off)
            .skip_frames(false)
            .qp(QpRange::new(26, 26))
            .bitrate(BitRate::from_bps(1_000_000))
            .max_frame_rate(FrameRate::from_hz(FRAMES_PER_SECOND as f32))
            .intra_frame_period(IntraFramePeriod::from_num_frames(KEYFRAME_EVERY))
            .scene_change_detect(false)
            .adaptive_quantization(false)
            .background_detection(false)
            .complexity(Complexity::Medium)
            .num_threads(1)
            .vui(VuiConfig::bt601());
        let encoder = Encoder::with_api_config(OpenH264API::from_source(), options)
            .context("cannot start the H.264 encoder")?;
        let (wide, high) = ((width * SCALE) as u32, (height * SCALE) as u32);
        let muxer = MuxerBuilder::new(Vec::new())
            .video(VideoCodec::H264, wide, high, f64::from(FRAMES_PER_SECOND))
            .with_fast_start(true)
            .build()
            .context("cannot start the video file")?;
        Ok(Self {
            height,
            width,
            encoder,
            scaled: vec![0; height * width * 3 * SCALE * SCALE],
            planes: YUVBuffer::new(width * SCALE, height * SCALE),
            muxer,
            frames: 0,
        })
    }

    /// Adds one frame of `height * width * 3` RGB bytes.
    pub fn push(&mut self, pixels: &[u8]) -> anyhow::Result<()> {
        let expected = self.height * self.width * 3;
        if pixels.len() != expected {
            bail!("video frame: expected {expected} bytes, got {}", pixels.len());
        }
        ensure!(self.frames < FRAMES_MAX, "video: expected at most {FRAMES_MAX} frames, got more");
        self.enlarge(pixels);
        let size = (self.width * SCALE, self.height * SCALE);
        self.planes.read_rgb8(RgbSliceU8::new(&self.scaled, size));
        let stream = self.encoder.encode(&self.planes).context("the H.264 encoder failed")?;
        let is_keyframe = matches!(stream.frame_type(), FrameType::IDR | FrameType::I);
        let seconds = self.frames as f64 / f64::from(FRAMES_PER_SECOND);
        self.muxer
            .write_video(seconds, &stream.to_vec(), is_keyframe)
            .with_context(|| format!("cannot add frame {} to the video file", self.frames))?;
        self.frames += 1;
        Ok(())
    }

    /// The finished MP4 file.
    pub fn finish(mut self) -> anyhow::Result<Vec<u8>> {
        ensure!(self.frames > 0, "video: expected at least one frame, got none");
        self.muxer.finish_in_place().context("cannot finish the video file")?;
        Ok(self.muxer.into_writer())
    }

    /// Doubles every pixel in both directions into `scaled`.
    fn enlarge(&mut self, pixels: &[u8]) {
        let wide = self.width * SCALE * 3;
        for (row, source) in pixels.chunks_exact(self.width * 3).enumerate() {
            let top = row * SCALE * wide;
            for (column, pixel) in source.chunks_exact(3).enumerate() {
                for copy in 0..SCALE {
                    let at = top + (column * SCALE + copy) * 3;
                    self.scaled[at..at + 3].copy_from_slice(pixel);
                }
            }
            for copy in 1..SCALE {
                self.scaled.copy_within(top..top + wide, top + copy * wide);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grey frame with a red square whose left edge moves one pixel per frame.
    fn frame(index: usize) -> Vec<u8> {
        let mut pixels = vec![128; 64 * 96 * 3];
        for row in 20..40 {
            for column in index..index + 20 {
                let at = (row * 96 + column) * 3;
                pixels[at..at + 3].copy_from_slice(&[220, 30, 30]);
            }
        }
        pixels
    }

    fn video(frames: usize) -> Vec<u8> {
        let mut video = Video::new(64, 96).expect("encoder");
        for index in 0..frames {
            video.push(&frame(index)).expect("frame");
        }
        video.finish().expect("file")
    }

    /// The length-prefixed units of the media box in Annex B format, preceded by the parameter
    /// sets.
    fn stream_of(file: &[u8]) -> Vec<u8> {
        let find = |name: &[u8]| file.windows(4).position(|window| window == name);
        let configuration = find(b"avcC").expect("avcC") + 4;
        let word = |at: usize| u16::from_be_bytes([file[at], file[at + 1]]) as usize;
        let mut stream = Vec::new();
        let sequence = configuration + 6;
        let picture = sequence + 2 + word(sequence) + 1;
        for at in [sequence, picture] {
            stream.extend_from_slice(&[0, 0, 0, 1]);
            stream.extend_from_slice(&file[at + 2..at + 2 + word(at)]);
        }
        let mut at = find(b"mdat").expect("mdat") + 4;
        while at < file.len() {
            let length = u32::from_be_bytes(file[at..at + 4].try_into().expect("four")) as usize;
            stream.extend_from_slice(&[0, 0, 0, 1]);
            stream.extend_from_slice(&file[at + 4..at + 4 + length]);
            at += 4 + length;
        }
        stream
    }

    #[test]
    fn every_frame_is_decoded_in_order_and_in_colour() {
        use openh264::decoder::Decoder;
        use openh264::formats::YUVSource;
        let stream = stream_of(&video(60));
        let mut decoder = Decoder::new().expect("decoder");
        let mut shown = 0;
        for packet in openh264::nal_units(&stream) {
            let Some(picture) = decoder.decode(packet).expect("decodes") else { continue };
            assert_eq!(picture.dimensions(), (192, 128));
            let mut pixels = vec![0; picture.rgb8_len()];
            picture.write_rgb8(&mut pixels);
            for (column, expected) in [(shown + 10, [220, 30, 30]), (shown + 26, [128, 128, 128])] {
                let at = (60 * 192 + column * 2) * 3;
                for (channel, value) in expected.iter().enumerate() {
                    let difference = i32::from(pixels[at + channel]) - value;
                    assert!(difference.abs() < 25, "frame {shown}, column {column}: {difference}");
                }
            }
            shown += 1;
        }
        assert_eq!(shown, 60);
    }

    #[test]
    fn the_same_frames_give_the_same_bytes() {
        assert_eq!(video(7), video(7));
    }

    #[test]
    fn wrong_frames_are_refused_with_a_reason() {
        let mut video = Video::new(64, 96).expect("encoder");
        let error = video.push(&[0; 12]).expect_err("short frame").to_string();
        assert_eq!(error, "video frame: expected 18432 bytes, got 12");
        assert!(Video::new(4, 96).is_err());
        assert!(Video::new(64, 96).expect("encoder").finish().is_err());
    }
}
