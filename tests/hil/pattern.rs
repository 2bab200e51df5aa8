//! Pictures whose every pixel is known from their number, in every format a UVC camera can send. The camera
//! (`uvc_camera.rs`) makes them, the tests (`cameras.rs`) ask for them back; of a recording, both play files instead.

use crate::jpeg;

/// Formats of a camera, by the names of the board file, with what their descriptor says: GUID's code, bits a pixel.
pub const FORMATS: [(&str, &[u8; 4], u8); 7] = [
    ("grey", b"Y800", 8),
    ("y10", b"Y10 ", 16),
    ("y12", b"Y12 ", 16),
    ("y16", b"Y16 ", 16),
    ("nv12", b"NV12", 12),
    ("yuyv", b"YUY2", 16),
    ("mjpeg", b"MJPG", 0),
];

/// Pixels of picture `k`. The first four say its number, the rest is a ramp that moves: a row or a byte too many shows.
pub fn grey(k: u32, width: usize, height: usize) -> Vec<u8> {
    let mut pixels = vec![0; width * height];
    for (y, row) in pixels.chunks_exact_mut(width).enumerate() {
        let base = (3 * y) as u32 + 7 * k;
        row.iter_mut().enumerate().for_each(|(x, p)| *p = (base + x as u32) as u8);
    }
    pixels[..4].copy_from_slice(&k.to_le_bytes());
    pixels
}

/// Levels of the blocks of compressed picture `k`: its number in the first eight, where a level more or less is none.
pub fn blocks(k: u32, width: usize, height: usize) -> Vec<u8> {
    let mut blocks: Vec<u8> =
        (0..width / 8 * (height / 8)).map(|i| (16 + (i as u32 * 5 + k * 3) % 220) as u8).collect();
    blocks.iter_mut().take(8).enumerate().for_each(|(i, b)| *b = ((k >> (4 * i) & 15) * 16 + 8) as u8);
    blocks
}

/// Picture `k` as the camera sends it. What is not grey is noise, and must not be seen.
pub fn packed(format: &str, k: u32, width: usize, height: usize) -> Vec<u8> {
    if format == "mjpeg" {
        return jpeg::flat(width, height, &blocks(k, width, height));
    }
    let grey = grey(k, width, height);
    let noise = (k as u8).wrapping_mul(37) | 1;
    let word = |shift: u32| -> Vec<u8> {
        let low = u16::from(noise) & ((1 << shift) - 1);
        grey.iter().flat_map(|g| (u16::from(*g) << shift | low).to_le_bytes()).collect()
    };
    match format {
        "y10" => word(2),
        "y12" => word(4),
        "y16" => word(8),
        "yuyv" => grey.iter().flat_map(|g| [*g, noise]).collect(),
        "nv12" => [&grey[..], &vec![noise; width * height / 2]].concat(),
        _ => grey,
    }
}

/// Number of a decoded picture.
pub fn number(format: &str, pixels: &[u8], width: usize) -> u32 {
    if format != "mjpeg" {
        return u32::from_le_bytes([pixels[0], pixels[1], pixels[2], pixels[3]]);
    }
    let level = |i: usize| pixels[8 * i / width * 8 * width + 8 * i % width + 3];
    (0..8).map(|i| u32::from(level(i) / 16) << (4 * i)).sum()
}

/// Pixels that differ from picture `k`.
pub fn wrong_pixels(format: &str, k: u32, pixels: &[u8], width: usize) -> usize {
    let height = pixels.len() / width;
    if format != "mjpeg" {
        return grey(k, width, height).iter().zip(pixels).filter(|(a, b)| a != b).count();
    }
    let blocks = blocks(k, width, height);
    let expected = |i: usize| blocks[i / width / 8 * (width / 8) + i % width / 8];
    pixels.iter().enumerate().filter(|(i, p)| p.abs_diff(expected(*i)) > 1).count()
}
