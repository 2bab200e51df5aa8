//! The smallest JPEG there is: every block of 8 x 8 pixels flat, grey or in colour. Tests need pictures whose every pixel is known, as
//! bytes that a camera would send. ITU-T T.81: baseline, one table each.

/// `blocks` are grey levels, row by row; sizes are multiples of 8. Decoded pixels are these, to a level.
pub fn flat(width: usize, height: usize, blocks: &[u8]) -> Vec<u8> {
    planes(width, height, &[blocks])
}

/// One plane of blocks, or those of Y, Cb and Cr.
pub fn planes(width: usize, height: usize, blocks: &[&[u8]]) -> Vec<u8> {
    let whole = blocks.iter().all(|plane| plane.len() == width / 8 * (height / 8));
    assert!(width % 8 == 0 && height % 8 == 0 && whole, "whole blocks");
    let components = 1..=blocks.len() as u8;
    let mut jpeg = vec![0xff, 0xd8];
    // Quantisation by 8: the mean of a block, which is coefficient 0 divided by 8, is then written as it is.
    segment(&mut jpeg, 0xdb, &[&[0][..], &[8; 64]].concat());
    let (h, w) = ((height as u16).to_be_bytes(), (width as u16).to_be_bytes());
    let of: Vec<u8> = components.clone().flat_map(|c| [c, 0x11, 0]).collect();
    segment(&mut jpeg, 0xc0, &[&[8, h[0], h[1], w[0], w[1], blocks.len() as u8][..], &of].concat());
    // Differences of 0 to 8 bits: nine codes of four bits each, their number is the code.
    segment(&mut jpeg, 0xc4, &[&[0x00, 0, 0, 0, 9][..], &[0; 12], &[0, 1, 2, 3, 4, 5, 6, 7, 8]].concat());
    // End of block, the one code there is: `0`.
    segment(&mut jpeg, 0xc4, &[&[0x10, 1][..], &[0; 15], &[0]].concat());
    let of: Vec<u8> = components.flat_map(|c| [c, 0x00]).collect();
    segment(&mut jpeg, 0xda, &[&[blocks.len() as u8][..], &of, &[0, 63, 0]].concat());
    let (mut bits, mut len, mut before) = (0u32, 0, vec![0i32; blocks.len()]);
    for (i, plane) in (0..blocks[0].len()).flat_map(|i| (0..blocks.len()).map(move |plane| (i, plane))) {
        let level = i32::from(blocks[plane][i]) - 128;
        let difference = level - before[plane];
        before[plane] = level;
        let size = 32 - difference.unsigned_abs().leading_zeros();
        let magnitude = if difference < 0 { (difference - 1) as u32 & ((1 << size) - 1) } else { difference as u32 };
        bits = (bits << 4 | size) << size | magnitude;
        bits <<= 1;
        len += 5 + size;
        while len >= 8 {
            len -= 8;
            push(&mut jpeg, (bits >> len) as u8);
        }
        bits &= (1 << len) - 1;
    }
    if len > 0 {
        push(&mut jpeg, (bits << (8 - len)) as u8 | (0xff >> len));
    }
    jpeg.extend([0xff, 0xd9]);
    jpeg
}

fn segment(jpeg: &mut Vec<u8>, marker: u8, payload: &[u8]) {
    jpeg.extend([0xff, marker]);
    jpeg.extend((payload.len() as u16 + 2).to_be_bytes());
    jpeg.extend(payload);
}

/// A byte of the scan: after 0xff stands a zero, so that it is no marker.
fn push(jpeg: &mut Vec<u8>, byte: u8) {
    jpeg.push(byte);
    if byte == 0xff {
        jpeg.push(0);
    }
}
