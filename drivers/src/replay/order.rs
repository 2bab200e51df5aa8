//! Keeps the longest strictly increasing subsequence of stamps and counts the rest.
//!
//! Dropping every row that is not newer than the last would let one corrupt stamp in the future cost all rows after it; the
//! longest increasing subsequence loses the fewest rows.

use super::findings::Findings;
use super::table::Row;
use crate::types::Nanos;
use std::path::Path;

/// The rows whose stamps grow; the others are counted as duplicated or out of order.
pub fn increasing<T>(
    rows: Vec<Row<T>>,
    stamp: impl Fn(&T) -> Nanos,
    path: &Path,
    findings: &mut Findings,
) -> Vec<Row<T>> {
    let stamps: Vec<Nanos> = rows.iter().map(|r| stamp(&r.value)).collect();
    let keep = longest_increasing(&stamps);
    let kept: std::collections::HashSet<Nanos> =
        stamps.iter().zip(&keep).filter(|(_, k)| **k).map(|(t, _)| *t).collect();
    let mut keep = keep.into_iter();
    let mut out = rows;
    out.retain(|row| {
        let keep = keep.next().expect("one flag a row");
        let t = stamp(&row.value);
        if !keep && kept.contains(&t) {
            findings.warn(|c| &mut c.stamps_duplicated, path, row.line, format!("stamp {} again: row dropped", t.0));
        } else if !keep {
            let what = format!("stamp {} is out of order: row dropped", t.0);
            findings.warn(|c| &mut c.stamps_out_of_order, path, row.line, what);
        }
        keep
    });
    out
}

/// Marks the longest increasing subsequence by patience sorting: `ends[n]` is where the best run of length n + 1 ends;
/// `before` links the members of runs.
fn longest_increasing(stamps: &[Nanos]) -> Vec<bool> {
    let mut ends: Vec<usize> = Vec::new();
    let mut before = vec![usize::MAX; stamps.len()];
    for (i, t) in stamps.iter().enumerate() {
        let n = ends.partition_point(|e| stamps[*e] < *t);
        before[i] = if n > 0 { ends[n - 1] } else { usize::MAX };
        match ends.get_mut(n) {
            None => ends.push(i),
            Some(end) if stamps[*end] > *t => *end = i,
            // The same stamp: the earlier row stays.
            Some(_) => {}
        }
    }
    let mut keep = vec![false; stamps.len()];
    let mut at = ends.last().copied().unwrap_or(usize::MAX);
    while at != usize::MAX {
        keep[at] = true;
        at = before[at];
    }
    keep
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(stamps: &[i64]) -> Vec<i64> {
        let stamps: Vec<Nanos> = stamps.iter().map(|t| Nanos(*t)).collect();
        stamps.iter().zip(longest_increasing(&stamps)).filter(|(_, k)| *k).map(|(t, _)| t.0).collect()
    }

    #[test]
    fn one_corrupt_stamp_costs_one_row() {
        assert_eq!(kept(&[1, 2, 900, 3, 4]), [1, 2, 3, 4]);
        assert_eq!(kept(&[10, 11, 2, 12, 13]), [10, 11, 12, 13]);
        assert_eq!(kept(&[1, 2, 2, 3]), [1, 2, 3]);
        assert_eq!(kept(&[5, 5, 5]), [5]);
        assert_eq!(kept(&[]), [0i64; 0]);
    }
}
