//! LZF, the compression of binary_compressed PCD (libLZF 3.6, its documented stream of literals and back-references).

/// Most bytes that one byte of a stream can unpack to: a back-reference of three bytes gives at most 264.
const MOST_EXPANSION: usize = 88;

/// The `length` bytes that `packed` unpacks to.
///
/// Allocates at most 88 times the length of `packed`.
///
/// # Errors
/// What is wrong, and what was expected.
pub(crate) fn unpack(packed: &[u8], length: usize) -> Result<Vec<u8>, (String, String)> {
    if length > packed.len().saturating_mul(MOST_EXPANSION) {
        return Err((
            format!("{} bytes packed", packed.len()),
            format!("more for {length} bytes"),
        ));
    }
    let mut out = Vec::with_capacity(length);
    let mut at = 0;
    let short = || {
        (
            "the end of the data".to_string(),
            "the rest of a run".to_string(),
        )
    };
    while at < packed.len() {
        let control = usize::from(packed[at]);
        at += 1;
        if control < 32 {
            let run = packed.get(at..at + control + 1).ok_or_else(short)?;
            out.extend_from_slice(run);
            at += control + 1;
        } else {
            let mut run = control >> 5;
            if run == 7 {
                run += usize::from(*packed.get(at).ok_or_else(short)?);
                at += 1;
            }
            let low = usize::from(*packed.get(at).ok_or_else(short)?);
            at += 1;
            let back = ((control & 31) << 8 | low) + 1;
            let Some(start) = out.len().checked_sub(back) else {
                return Err((
                    format!("a reference {back} bytes back at byte {}", out.len()),
                    "one into the bytes before".into(),
                ));
            };
            // Byte by byte: a run may reach into what it is just writing.
            for i in start..start + run + 2 {
                out.push(out[i]);
            }
        }
        if out.len() > length {
            break;
        }
    }
    if out.len() != length {
        return Err((format!("{} bytes", out.len()), format!("{length} bytes")));
    }
    Ok(out)
}
