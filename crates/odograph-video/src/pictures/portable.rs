//! PGM and PPM, plain and raw (netpbm formats P2, P3, P5, P6).

use crate::codec::narrow_full_scale;
use crate::frame::{Picture, picture_from_rgb};
use crate::limits;
use odograph::error::{Error, Result};
use odograph::image::GrayImage;

/// Decodes one image.
pub(super) fn decode(bytes: &[u8], color: bool) -> Result<Picture> {
    let cut_off = || Error::input("the picture is cut off");
    let (kind, mut rest) = bytes.split_at_checked(2).ok_or_else(cut_off)?;
    let (channels, plain) = match kind {
        b"P2" => (1, true),
        b"P3" => (3, true),
        b"P5" => (1, false),
        b"P6" => (3, false),
        _ => return Err(Error::input("this is not a PGM or PPM picture")),
    };
    let mut number =
        || number(&mut rest).ok_or_else(|| Error::input("the head of this PGM or PPM picture is damaged"));
    let (width, height, most) = (number()?, number()?, number()?);
    let samples = channels * limits::check_size(width, height)?;
    if !(1..=65_535).contains(&most) {
        return Err(Error::input(format!("a largest value of {most} cannot be in a PGM or PPM picture")));
    }
    let scaled = |value: usize| match most {
        255 => value.min(255) as u8,
        65_535 => narrow_full_scale(value.min(65_535) as u16),
        _ => ((value.min(most) * 255 + most / 2) / most) as u8,
    };
    let narrowed: Vec<u8> = if plain {
        // A plain sample has at least two characters, so a short file cannot claim much memory.
        if rest.len() < 2 * samples - 1 {
            return Err(cut_off());
        }
        (0..samples).map_while(|_| self::number(&mut rest)).map(scaled).collect()
    } else {
        // One white space character ends the header.
        let data = rest.get(1..).ok_or_else(cut_off)?;
        if most < 256 {
            data.iter().take(samples).map(|&s| scaled(usize::from(s))).collect()
        } else {
            data.chunks_exact(2)
                .take(samples)
                .map(|s| scaled(usize::from(s[0]) << 8 | usize::from(s[1])))
                .collect()
        }
    };
    if narrowed.len() != samples {
        return Err(cut_off());
    }
    let picture = if channels == 1 {
        GrayImage::from_samples(width, height, narrowed).map(Picture::gray)
    } else {
        picture_from_rgb(width, height, narrowed, color)
    };
    picture.ok_or_else(cut_off)
}

/// Parses the next number; skips white space and comments before it.
fn number(rest: &mut &[u8]) -> Option<usize> {
    loop {
        match rest {
            [b'#', after @ ..] => {
                let end = after.iter().position(|&b| b == b'\n')?;
                *rest = &after[end..];
            }
            [space, after @ ..] if space.is_ascii_whitespace() => *rest = after,
            _ => break,
        }
    }
    let digits = rest.iter().take_while(|b| b.is_ascii_digit()).count();
    if digits == 0 || digits > 9 {
        return None;
    }
    let (digits, after) = rest.split_at(digits);
    *rest = after;
    Some(digits.iter().fold(0, |value, &b| 10 * value + usize::from(b - b'0')))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn raw_plain_and_deep() {
        let gray = |bytes: &[u8]| decode(bytes, false).unwrap().gray.into_samples();
        assert_eq!(gray(b"P5 # a comment\n2 1\n255\nab"), b"ab");
        assert_eq!(gray(b"P2\n3 1\n15\n0 15 7\n"), [0, 255, 119]);
        assert_eq!(gray(b"P5 2 1 65535\n\xff\xff\x01\x7f"), [255, 1]);
        assert_eq!(gray(b"P6 1 1 255\n\x10\x10\x10"), [16]);
        assert!(decode(b"P6 1 1 255\nabc", true).unwrap().color.is_some());
    }

    #[test]
    fn damaged() {
        for bytes in [
            &b"P5"[..],
            b"P5 2 2 255\nabc",
            b"P5 0 2 255\n",
            b"P2 9999 9999 255\n1",
            b"P5 2 2 0\nabcd",
            b"P7 1 1",
        ] {
            assert!(decode(bytes, false).is_err());
        }
    }
}
