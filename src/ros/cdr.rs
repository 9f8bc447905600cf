//! CDR as ROS 2 writes it: plain XCDR version 1, little-endian, behind an encapsulation header of four bytes (`00 01 00 00`).
//!
//! Every number begins at a multiple of its own size, counted from behind that header. A string is its length with the closing zero,
//! the bytes and the zero; a sequence is its length and its elements; an array is its elements; a message is its fields.
//! Source: OMG DDS-RTPS 2.5, 10 (encapsulation) and OMG CORBA 3.3, part 2, 9.3 (CDR). Cost: a copy.
//!
//! Not here: big-endian data, parameter lists and XCDR version 2, which no ROS 2 writes into a bag.

/// Little-endian plain CDR, and two bytes of options that are zero.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// Why bytes are not the message that they should be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    #[error("begins with {0:02x?} and not with 00 01 as little-endian CDR does")]
    Encapsulation(Vec<u8>),
    #[error("ends at byte {have}, {need} bytes are needed")]
    Short { have: usize, need: usize },
    #[error("holds a text that is not UTF-8")]
    Text,
}

/// Appends values to a message.
#[derive(Debug, Clone)]
pub struct Writer {
    bytes: Vec<u8>,
}

impl Default for Writer {
    fn default() -> Self {
        Self { bytes: ENCAPSULATION.to_vec() }
    }
}

impl Writer {
    /// Room for so many bytes without growing.
    pub fn with_capacity(bytes: usize) -> Self {
        let mut writer = Self { bytes: Vec::with_capacity(bytes + ENCAPSULATION.len()) };
        writer.bytes.extend_from_slice(&ENCAPSULATION);
        writer
    }

    /// The message.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// A number's little-endian bytes, at a multiple of their number.
    pub fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        let behind = (self.bytes.len() - ENCAPSULATION.len()) % N;
        if behind > 0 {
            self.bytes.resize(self.bytes.len() + N - behind, 0);
        }
        self.bytes.extend_from_slice(&bytes);
    }

    /// The length of a sequence or text. More than 4 G elements fit into no message.
    pub fn length(&mut self, length: usize) {
        self.number(u32::try_from(length).unwrap_or(u32::MAX).to_le_bytes());
    }

    /// Bytes as they are.
    pub fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }
}

/// Takes values from a message, in the order of its fields. Nothing is believed: what is not there is an error.
#[derive(Debug, Clone)]
pub struct Reader<'a> {
    /// Behind the encapsulation header.
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    /// Checks the encapsulation header.
    pub fn new(message: &'a [u8]) -> Result<Self, CdrError> {
        match message.split_at_checked(ENCAPSULATION.len()) {
            Some((header, bytes)) if header[..2] == ENCAPSULATION[..2] => Ok(Self { bytes, at: 0 }),
            Some((header, _)) => Err(CdrError::Encapsulation(header.to_vec())),
            None => Err(CdrError::Short { have: message.len(), need: ENCAPSULATION.len() }),
        }
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], CdrError> {
        let need = self.at.saturating_add(count);
        let taken = self.bytes.get(self.at..need).ok_or(CdrError::Short { have: self.bytes.len(), need })?;
        self.at = need;
        Ok(taken)
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let behind = self.at % N;
        if behind > 0 {
            self.take(N - behind)?;
        }
        let mut number = [0; N];
        number.copy_from_slice(self.take(N)?);
        Ok(number)
    }

    pub fn u8(&mut self) -> Result<u8, CdrError> {
        self.number::<1>().map(|[byte]| byte)
    }

    pub fn u32(&mut self) -> Result<u32, CdrError> {
        self.number().map(u32::from_le_bytes)
    }

    pub fn i32(&mut self) -> Result<i32, CdrError> {
        self.number().map(i32::from_le_bytes)
    }

    pub fn f64(&mut self) -> Result<f64, CdrError> {
        self.number().map(f64::from_le_bytes)
    }

    /// A text, without its closing zero.
    pub fn text(&mut self) -> Result<&'a str, CdrError> {
        let length = self.u32()? as usize;
        let bytes = self.take(length)?;
        std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes)).map_err(|_| CdrError::Text)
    }

    /// A sequence of bytes, where they lie.
    pub fn bytes(&mut self) -> Result<&'a [u8], CdrError> {
        let length = self.u32()? as usize;
        self.take(length)
    }

    /// A sequence of floating-point numbers.
    pub fn f64_sequence(&mut self) -> Result<Vec<f64>, CdrError> {
        let length = self.u32()? as usize;
        // A length that lies must not reserve memory.
        let room = (self.bytes.len() - self.at) / size_of::<f64>();
        let mut numbers = Vec::with_capacity(length.min(room));
        for _ in 0..length {
            numbers.push(self.f64()?);
        }
        Ok(numbers)
    }

    /// An array of floating-point numbers.
    pub fn f64_array<const N: usize>(&mut self) -> Result<[f64; N], CdrError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64()?;
        }
        Ok(numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_lie_where_their_size_says_counted_from_behind_the_header() {
        let mut w = Writer::default();
        w.number([7]);
        w.number(0x0102_0304_u32.to_le_bytes());
        w.length(3);
        w.raw(b"ab\0");
        w.number(1.0_f64.to_le_bytes());
        let bytes = w.into_bytes();
        let want = [
            [0, 1, 0, 0, 7, 0, 0, 0],
            [4, 3, 2, 1, 3, 0, 0, 0],
            [b'a', b'b', 0, 0, 0, 0, 0, 0],
            [0, 0, 0xf0, 0x3f, 0, 0, 0, 0],
        ];
        // The last number begins at 16 behind the header.
        assert_eq!(bytes[..20], want.concat()[..20]);
        assert_eq!(bytes.len(), 4 + 16 + 8);
        let mut r = Reader::new(&bytes).expect("header");
        assert_eq!((r.u8(), r.u32(), r.text(), r.f64()), (Ok(7), Ok(0x0102_0304), Ok("ab"), Ok(1.0)));
    }

    #[test]
    fn what_is_cut_off_or_lies_is_an_error() {
        let mut w = Writer::default();
        w.length(2);
        w.number(1.0_f64.to_le_bytes());
        w.number(2.0_f64.to_le_bytes());
        let bytes = w.into_bytes();
        assert_eq!(Reader::new(&bytes).and_then(|mut r| r.f64_sequence()), Ok(vec![1.0, 2.0]));
        for end in 0..bytes.len() {
            assert!(Reader::new(&bytes[..end]).and_then(|mut r| r.f64_sequence()).is_err(), "{end}");
        }
        let lie = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 1];
        let short = |e| matches!(e, CdrError::Short { .. });
        assert!(Reader::new(&lie).and_then(|mut r| r.bytes()).is_err_and(short));
        assert!(Reader::new(&lie).and_then(|mut r| r.f64_sequence()).is_err_and(short));
        let big_endian = Reader::new(&[0, 0, 0, 0, 1]).map(|_| ());
        assert_eq!(big_endian, Err(CdrError::Encapsulation(vec![0, 0, 0, 0])));
    }
}
