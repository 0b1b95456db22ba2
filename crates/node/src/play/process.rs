// SPDX-License-Identifier: MIT OR Apache-2.0
//! Frame sets made on demand by a process of its own: triggers come in, a line each, answers go out in the same order.
//!
//! An answer is a byte (0: the requested frame set; 1: there is none, or why it cannot be made), a length (u32,
//! little-endian), and that many bytes. The first answer, before any request, is what a player must know
//! ([`Described`], JSON).

use super::Sequence;
use super::sequence::Described;
use std::io::{self, BufRead, Read, Write};
use std::path::Path;

/// Longest answer, bytes: a larger one is refused by both sides.
pub const ANSWER_BYTES_MAX: usize = 8 << 20;

/// What was made, or why nothing was.
pub type Answer = Result<Vec<u8>, String>;

/// Answers until the input ends. The rate is that of a result that states no times.
///
/// # Errors
/// The answers cannot be written.
pub fn serve(
    result: &Path,
    trigger_rate_hz: f64,
    points_each: usize,
    asked: impl BufRead,
    mut out: impl Write,
) -> io::Result<()> {
    let sequence = match Sequence::open(result) {
        Ok(sequence) => sequence,
        Err(reason) => return write_answer(&mut out, &Err(reason)),
    };
    let described: Described = sequence.described(trigger_rate_hz, points_each);
    write_answer(&mut out, &serde_json::to_vec(&described).map_err(|e| e.to_string()))?;
    for line in asked.lines() {
        let answer = match line?.parse() {
            Ok(trigger) => sequence
                .packed(trigger, points_each)
                .unwrap_or_else(|| Err(format!("trigger {trigger} has no cloud"))),
            Err(error) => Err(format!("expected a trigger: {error}")),
        };
        write_answer(&mut out, &answer)?;
    }
    Ok(())
}

fn write_answer(out: &mut impl Write, answer: &Answer) -> io::Result<()> {
    let (kind, bytes) = match answer {
        Ok(bytes) if bytes.len() <= ANSWER_BYTES_MAX => (0, &bytes[..]),
        Ok(_) => (1, &b"too large to be shown"[..]),
        Err(reason) => (1, reason.as_bytes()),
    };
    let bytes = &bytes[..bytes.len().min(ANSWER_BYTES_MAX)];
    let length = u32::try_from(bytes.len()).map_err(io::Error::other)?;
    out.write_all(&[kind])?;
    out.write_all(&length.to_le_bytes())?;
    out.write_all(bytes)?;
    out.flush()
}

/// Reads the next answer.
///
/// # Errors
/// The process has ended, or wrote something else.
pub fn read_answer(from: &mut impl Read) -> io::Result<Answer> {
    let mut head = [0; 5];
    from.read_exact(&mut head)?;
    let [kind, length @ ..] = head;
    let length = u32::from_le_bytes(length) as usize;
    if kind > 1 || length > ANSWER_BYTES_MAX {
        return Err(io::Error::new(io::ErrorKind::InvalidData, "not an answer of this program"));
    }
    let mut bytes = vec![0; length];
    from.read_exact(&mut bytes)?;
    Ok(if kind == 0 { Ok(bytes) } else { Err(String::from_utf8_lossy(&bytes).into_owned()) })
}

#[cfg(test)]
mod tests {
    use super::{ANSWER_BYTES_MAX, read_answer, serve, write_answer};
    use proptest::prelude::{any, prop_assert_eq, proptest};
    use std::io::ErrorKind;

    #[test]
    fn answers_come_as_they_were_given() {
        let answers = [Ok(vec![1, 2, 3]), Err("no cloud".to_owned()), Ok(Vec::new())];
        let mut bytes = Vec::new();
        answers.iter().for_each(|answer| write_answer(&mut bytes, answer).expect("written"));
        let mut from = &bytes[..];
        for answer in &answers {
            assert_eq!(read_answer(&mut from).as_ref().ok(), Some(answer));
        }
        assert_eq!(read_answer(&mut from).map_err(|e| e.kind()), Err(ErrorKind::UnexpectedEof));
    }

    #[test]
    fn what_is_too_long_claims_no_memory() {
        let mut bytes = Vec::new();
        write_answer(&mut bytes, &Ok(vec![0; ANSWER_BYTES_MAX + 1])).expect("written");
        assert_eq!(read_answer(&mut &bytes[..]).ok(), Some(Err("too large to be shown".to_owned())));
        let huge = [0, 255, 255, 255, 255, 1, 2];
        assert_eq!(read_answer(&mut &huge[..]).map_err(|e| e.kind()), Err(ErrorKind::InvalidData));
    }

    #[test]
    fn a_result_that_is_not_there_is_told() {
        let dir = tempfile::tempdir().expect("a directory");
        let mut out = Vec::new();
        serve(dir.path(), 120.0, 100, &b"0\n"[..], &mut out).expect("told");
        let told = read_answer(&mut &out[..]).expect("an answer").expect_err("nothing is there");
        assert!(told.contains("summary.json"), "{told}");
    }

    proptest! {
        #[test]
        fn whatever_is_read_is_an_answer_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..64)) {
            if let Ok(answer) = read_answer(&mut &bytes[..]) {
                let mut again = Vec::new();
                if answer.as_ref().err().is_none_or(|said| !said.contains('\u{fffd}')) {
                    write_answer(&mut again, &answer).expect("written");
                    prop_assert_eq!(&again[..], &bytes[..again.len()]);
                }
            }
        }
    }
}
