//! Twin of sum_chunks.comp, and the walk over slots of who reads them next.

/// Slots of a chunk: CHUNK of chunks.glsl.
const CHUNK: usize = 16;
/// Word of a slot: α dL/dα.
const WORTH: usize = 5;

/// Twin of sum_chunks.comp, on slots of `words`.
pub fn sum_chunks(owners: &[u32], slots: &mut [f64], words: usize) {
    for first in (0..(owners.len() + 1).saturating_sub(CHUNK)).step_by(CHUNK) {
        if owners[first] != owners[first + CHUNK - 1] {
            continue;
        }
        let chunk = &mut slots[first * words..(first + CHUNK) * words];
        let sum = |word: usize, of: fn(f64) -> f64| (0..CHUNK).map(|k| of(chunk[k * words + word])).sum();
        let (sums, worth): (Vec<f64>, f64) = ((0..words).map(|w| sum(w, |g| g)).collect(), sum(WORTH, f64::abs));
        chunk[..words].copy_from_slice(&sums);
        chunk[words] = worth;
    }
}

/// Σ |α dL/dα| over the slots `tiles` of one Gaussian, of `words`, once its chunks are summed.
pub fn worth(slots: &[f32], words: usize, tiles: std::ops::Range<usize>, chunk: usize) -> f64 {
    let (mut i, mut sum) = (tiles.start, 0.0);
    while i < tiles.end {
        let whole = chunk > 1 && i % chunk == 0 && i + chunk <= tiles.end;
        sum += f64::from(if whole { slots[(i + 1) * words] } else { slots[i * words + WORTH].abs() });
        i += if whole { chunk } else { 1 };
    }
    sum
}
