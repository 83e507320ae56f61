//! Network abstraction layer (NAL) units, the packets of H.264 and H.265 streams.

/// Framing of the NAL units of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NalFraming {
    /// Start codes between the units (Annex B).
    StartCodes,
    /// A big-endian length of the given number of bytes (1, 2 or 4) before each unit.
    Lengths(usize),
}

impl NalFraming {
    /// Splits a sample into its units, without start codes or lengths. A truncated unit is dropped.
    pub fn split<'a>(self, sample: &'a [u8], units: &mut Vec<&'a [u8]>) {
        units.clear();
        match self {
            Self::StartCodes => split_start_codes(sample, units),
            Self::Lengths(size) => {
                let mut rest = sample;
                while rest.len() > size {
                    let (length, after) = rest.split_at(size);
                    let length = length.iter().fold(0usize, |l, &b| l << 8 | usize::from(b));
                    let Some((unit, after)) = after.split_at_checked(length) else { break };
                    if !unit.is_empty() {
                        units.push(unit);
                    }
                    rest = after;
                }
            }
        }
    }
}

fn split_start_codes<'a>(bytes: &'a [u8], units: &mut Vec<&'a [u8]>) {
    let mut start = None;
    let mut from = 0;
    loop {
        let code = find_start_code(bytes, from);
        if let Some(start) = start {
            let mut unit: &[u8] = &bytes[start..code.unwrap_or(bytes.len())];
            while let [shorter @ .., 0] = unit {
                unit = shorter;
            }
            if !unit.is_empty() {
                units.push(unit);
            }
        }
        let Some(code) = code else { return };
        from = code + 3;
        start = Some(from);
    }
}

/// Position of the next start code `00 00 01`.
pub(crate) fn find_start_code(bytes: &[u8], from: usize) -> Option<usize> {
    let mut at = from;
    while at + 2 < bytes.len() {
        match bytes[at + 2] {
            0 => at += 1,
            1 if bytes[at] == 0 && bytes[at + 1] == 0 => return Some(at),
            _ => at += 3,
        }
    }
    None
}

/// Removes emulation prevention bytes (`00 00 03` → `00 00`).
pub(crate) fn unescape(payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(payload.len());
    let mut zeros = 0;
    for &byte in payload {
        if zeros >= 2 && byte == 3 {
            zeros = 0;
            continue;
        }
        zeros = if byte == 0 { zeros + 1 } else { 0 };
        out.push(byte);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn start_codes_of_three_and_four_bytes() {
        let bytes = [9, 0, 0, 0, 1, 0x67, 1, 2, 0, 0, 1, 0x68, 3, 0, 0, 0, 1, 0x65];
        let mut units = Vec::new();
        NalFraming::StartCodes.split(&bytes, &mut units);
        assert_eq!(units, [&[0x67, 1, 2][..], &[0x68, 3], &[0x65]]);
    }

    #[test]
    fn truncated_units_are_dropped() {
        let mut units = Vec::new();
        NalFraming::Lengths(2).split(&[0, 1, 7, 0, 9, 1], &mut units);
        assert_eq!(units, [&[7][..]]);
    }

    #[test]
    fn emulation_prevention_is_removed() {
        assert_eq!(unescape(&[1, 0, 0, 3, 1, 0, 0, 3]), [1, 0, 0, 1, 0, 0]);
    }
}
