//! Parser of the H.265 sequence parameter set (ITU-T H.265, 7.3.2.2.1 and E.2.1), limited to what
//! is used.

use super::bits::Bits;
use super::h264_parameters::read_color_encoding;
use crate::frame::ColorEncoding;
use crate::nal::unescape;

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct HevcSequenceParameters {
    pub profile: u8,
    pub width: usize,
    pub height: usize,
    pub bit_depth: u32,
    pub reorder_depth: usize,
    pub encoding: ColorEncoding,
    pub frames_per_second: Option<f64>,
}

impl HevcSequenceParameters {
    /// Parses a NAL unit of type 33, including its two header bytes.
    pub fn read(unit: &[u8]) -> Option<Self> {
        if unit.first()? >> 1 & 63 != 33 {
            return None;
        }
        let payload = unescape(unit.get(2..)?);
        let mut bits = Bits::new(&payload);
        bits.skip(4)?;
        let sub_layers = bits.bits(3)?;
        bits.skip(1)?;
        let profile = profile_tier_level(&mut bits, sub_layers)?;
        bits.ue()?;
        let chroma_format = bits.ue()?;
        if chroma_format == 3 {
            bits.bit()?;
        }
        let (width, height) = (bits.ue()? as usize, bits.ue()? as usize);
        if bits.bit()? {
            for _ in 0..4 {
                bits.ue()?;
            }
        }
        let bit_depth = bits.ue()?.checked_add(8)?;
        bits.ue()?;
        let order_count_bits = bits.ue()?.checked_add(4)?;
        let each = bits.bit()?;
        let mut reorder_depth = 0;
        for _ in if each { 0 } else { sub_layers }..=sub_layers {
            bits.ue()?;
            reorder_depth = bits.ue()?.min(16) as usize;
            bits.ue()?;
        }
        let mut read = Self {
            profile,
            width,
            height,
            bit_depth,
            reorder_depth,
            encoding: ColorEncoding::default(),
            frames_per_second: None,
        };
        // The rest is optional: only colour encoding and frame rate come from it.
        let _ = read.tools_and_usability(&mut bits, order_count_bits);
        Some(read)
    }

    fn tools_and_usability(&mut self, bits: &mut Bits<'_>, order_count_bits: u32) -> Option<()> {
        for _ in 0..6 {
            bits.ue()?;
        }
        if bits.bit()? && bits.bit()? {
            skip_scaling_lists(bits)?;
        }
        bits.skip(2)?;
        if bits.bit()? {
            bits.skip(8)?;
            bits.ue()?;
            bits.ue()?;
            bits.bit()?;
        }
        let sets = bits.ue().filter(|&s| s <= 64)?;
        let mut pictures_before = 0;
        for set in 0..sets {
            pictures_before = skip_reference_set(bits, set, pictures_before)?;
        }
        if bits.bit()? {
            for _ in 0..bits.ue().filter(|&n| n <= 32)? {
                bits.skip(order_count_bits as usize + 1)?;
            }
        }
        bits.skip(2)?;
        if bits.bit()? { self.usability(bits) } else { Some(()) }
    }

    fn usability(&mut self, bits: &mut Bits<'_>) -> Option<()> {
        read_color_encoding(bits, &mut self.encoding)?;
        bits.skip(3)?;
        if bits.bit()? {
            for _ in 0..4 {
                bits.ue()?;
            }
        }
        if bits.bit()? {
            let (ticks, scale) = (bits.bits(32)?, bits.bits(32)?);
            if ticks > 0 && scale > 0 {
                self.frames_per_second = Some(f64::from(scale) / f64::from(ticks));
            }
        }
        Some(())
    }

    /// Common name of the profile.
    pub fn profile_name(&self) -> &'static str {
        match self.profile {
            1 => "Main",
            2 => "Main 10",
            3 => "Main Still Picture",
            4 => "Range Extensions",
            9 => "Screen Content Coding",
            _ => "another profile",
        }
    }
}

/// Skips the profile, tier and level; returns the general profile.
fn profile_tier_level(bits: &mut Bits<'_>, sub_layers: u32) -> Option<u8> {
    bits.skip(3)?;
    let profile = bits.bits(5)? as u8;
    bits.skip(88)?;
    let mut present = Vec::new();
    for _ in 0..sub_layers {
        present.push((bits.bit()?, bits.bit()?));
    }
    if sub_layers > 0 {
        bits.skip(2 * (8 - sub_layers) as usize)?;
    }
    for (has_profile, has_level) in present {
        bits.skip(if has_profile { 88 } else { 0 } + if has_level { 8 } else { 0 })?;
    }
    Some(profile)
}

fn skip_scaling_lists(bits: &mut Bits<'_>) -> Option<()> {
    for size in 0..4 {
        for _ in (0..6).step_by(if size == 3 { 3 } else { 1 }) {
            if !bits.bit()? {
                bits.ue()?;
                continue;
            }
            if size > 1 {
                bits.se()?;
            }
            for _ in 0..64.min(1 << (4 + 2 * size)) {
                bits.se()?;
            }
        }
    }
    Some(())
}

/// Skips a short-term reference picture set; returns its number of pictures, which the next set
/// depends on.
fn skip_reference_set(bits: &mut Bits<'_>, set: u32, pictures_before: u32) -> Option<u32> {
    if set > 0 && bits.bit()? {
        bits.bit()?;
        bits.ue()?;
        let mut pictures = 0;
        for _ in 0..=pictures_before {
            if bits.bit()? || bits.bit()? {
                pictures += 1;
            }
        }
        return Some(pictures);
    }
    let pictures = bits.ue().filter(|&n| n <= 16)? + bits.ue().filter(|&n| n <= 16)?;
    for _ in 0..pictures {
        bits.ue()?;
        bits.bit()?;
    }
    Some(pictures)
}
