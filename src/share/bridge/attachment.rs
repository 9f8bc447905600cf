//! What rmw_zenoh sends with each message: its number, its time and who sent it.
//!
//! 33 bytes: number (i64) and Unix time in ns (i64), both little-endian, a 16, and the sender's id of 16 bytes. With a request it is the client's, and the
//! answer has its number and id again. Source: rmw_zenoh, docs/design.md, "Publishers".

/// Bytes of a sender's id.
pub const GID_BYTES: usize = 16;

pub const BYTES: usize = 8 + 8 + 1 + GID_BYTES;

/// See module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attachment {
    pub sequence: i64,
    /// Unix time, ns.
    pub time_ns: i64,
    pub gid: [u8; GID_BYTES],
}

impl Attachment {
    pub fn to_bytes(self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(BYTES);
        bytes.extend_from_slice(&self.sequence.to_le_bytes());
        bytes.extend_from_slice(&self.time_ns.to_le_bytes());
        bytes.push(GID_BYTES as u8);
        bytes.extend_from_slice(&self.gid);
        bytes
    }

    /// `None` if it is none.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (sequence, rest) = bytes.split_first_chunk()?;
        let (time_ns, rest) = rest.split_first_chunk()?;
        let ([length], gid) = rest.split_first_chunk()?;
        let gid: [u8; GID_BYTES] = gid.try_into().ok()?;
        let (sequence, time_ns) = (i64::from_le_bytes(*sequence), i64::from_le_bytes(*time_ns));
        (usize::from(*length) == GID_BYTES).then_some(Self { sequence, time_ns, gid })
    }
}

/// The id of whoever has this liveliness token.
pub fn gid(token: &str) -> [u8; GID_BYTES] {
    // The lower half comes first.
    xxhash_rust::xxh3::xxh3_128(token.as_bytes()).to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_attachment_has_33_bytes_and_nothing_else_is_one() {
        let gid: [u8; GID_BYTES] = std::array::from_fn(|i| i as u8 + 1);
        let attachment = Attachment { sequence: 0x0102, time_ns: -2, gid };
        let bytes = attachment.to_bytes();
        assert_eq!(bytes.len(), 33);
        assert_eq!(bytes[..8], [2, 1, 0, 0, 0, 0, 0, 0]);
        assert_eq!((bytes[8], bytes[15], bytes[16], bytes[17], bytes[32]), (0xfe, 0xff, 16, 1, 16));
        assert_eq!(Attachment::from_bytes(&bytes), Some(attachment));
        for end in 0..bytes.len() {
            assert_eq!(Attachment::from_bytes(&bytes[..end]), None, "{end}");
        }
        let longer: Vec<u8> = bytes.iter().copied().chain([0]).collect();
        let lie: Vec<u8> = bytes.iter().enumerate().map(|(i, b)| if i == 16 { 15 } else { *b }).collect();
        assert_eq!((Attachment::from_bytes(&longer), Attachment::from_bytes(&lie)), (None, None));
    }

    #[test]
    fn an_id_is_xxh3_with_its_lower_half_first() {
        // XXH3_128bits of nothing, seed 0, as its authors' own test has it: low64 and high64.
        let (low, high) = (0x6001_c324_468d_497f_u64, 0x99aa_06d3_0147_98d8_u64);
        assert_eq!(gid(""), <[u8; 16]>::try_from([low.to_le_bytes(), high.to_le_bytes()].concat()).expect("16"));
    }
}
