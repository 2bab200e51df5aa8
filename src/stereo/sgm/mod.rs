//! Census semi-global matching on the GPU: a rectified pair in, disparities of the left image with their standard
//! deviation out.
//!
//! ```text
//! census -> aggregate, once a direction -> match_right -> match_left    Hirschmüller 2008, Zabih and Woodfill 1994
//! verify -> speckle_join -> speckle_count -> speckle_drop              what is likely wrong
//! fill_rows -> median -> smooth_lines, rows and columns -> settle       wls.rs: Min et al. 2014
//! ```
//!
//! There is no volume of costs: the eight passes over the one volume of sums count Hamming distances anew. When the sums are
//! read they are free, and what the filter needs lies where they were.
//! Where the picture shows little but noise, a census finds noise: about a fifth of what both eyes see of simulated flights is
//! left unknown, and most of what is bad by 1 px after the filter was filled in there. OpenCV's semi-global block matching
//! weighs differences by their size, and with its filter has fewer bad pixels on seven of ten flights (2.6 %, here 2.9),
//! though not on cones and teddy.
//!
//! All until the filter is integers, and no sum depends on the order of threads: the result is the same in every run.

pub mod wls;

use super::rectify_gpu::{image_bytes, pack, packed, Rectifier};
use super::Disparity;
use crate::config::StereoConfig;
use crate::gpu::kernels::{
    aggregate, census, match_left, match_right, speckle_count, speckle_drop, speckle_join, verify,
};
use crate::gpu::{Arena, Buf, DeviceKind, Gpu, GpuError, Kernel, Recorder, Threads, ALIGN};
use stipple_drivers::{Fault, Image};
use wls::Wls;

/// Disparities one invocation of `aggregate` holds.
const RUN: u32 = 8;
/// Invocations of a workgroup of `aggregate`: about one subgroup, whose barriers are cheap.
const GROUP_GPU: u32 = 32;
const GROUP_CPU: u32 = 8;
/// Cost of a match outside the right image, of 32: a little below that of a wrong match, so that what is there continues
/// what is seen beside it.
pub const OUTSIDE: u32 = 8;
/// Penalties of the smoothness term, in Hamming distance. At 8, 50 and 10 at least, 2.9 % of simulated flights, 9.4 and
/// 11.7 % of cones and teddy are bad by 1 px after the filter, not 2.6, 9.4 and 11.6; and 68 % of poles up to 6 px wide is
/// found, not 66.
pub const P1: u32 = 11;
pub const P2: u32 = 60;
pub const P2_MIN: u32 = 12;
/// What a grey level of difference takes off `P2`.
pub const P2_SLOPE: u32 = 2;
/// Left and right may differ by this, px.
pub const DISAGREE: u32 = 1;
/// Sums of 9 Hamming distances, 144 by chance and less by a blank wall: the most a match may have, the most of one that is
/// asked whether it repeats, and how much more a repetition may have and what lies between must. Of stripes under 0.5 % stays,
/// in islands; at 126 a blank right eye is matched in 2 % of the left.
pub const CHANCE: u32 = 108;
pub const REPEAT_FIT: u32 = 54;
pub const REPEAT_ALIKE: u32 = 6;
pub const REPEAT_WALL: u32 = 54;
/// Neighbours this close are of one surface, px; surfaces of fewer pixels are none. At 100 of poles
/// 4 px wide 19 % is found, not 43; at 20 both pairs have 0.1 % more wrong.
pub const SPECKLE_CLOSE: f32 = 1.0;
pub const SPECKLE_AREA: u32 = 40;

/// Across, down and diagonal; the first four are what a small GPU takes.
pub const DIRECTIONS: [[i32; 2]; 8] = [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, 1], [1, -1], [-1, -1]];

/// What the matcher is made for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    pub width: usize,
    pub height: usize,
    /// A multiple of 16, at most 512.
    pub disparities: u32,
    /// Directions of aggregation, 4 or 8.
    pub paths: u32,
    /// The best match must beat the second by this, percent.
    pub uniqueness_percent: u32,
    pub wls: bool,
}

impl Shape {
    pub fn of(width: usize, height: usize, config: &StereoConfig) -> Shape {
        Shape {
            width,
            height,
            disparities: config.disparities,
            paths: config.sgm_paths,
            uniqueness_percent: config.sgm_uniqueness_percent,
            wls: config.wls,
        }
    }

    fn pixels(&self) -> usize {
        self.width * self.height
    }

    fn size(&self) -> [u32; 2] {
        [self.width as u32, self.height as u32]
    }

    /// Elements of four bytes a pixel, so that the next buffer is aligned.
    fn plane(&self) -> usize {
        self.pixels().next_multiple_of(ALIGN as usize / 4)
    }
}

struct Kernels {
    census: Kernel<census::K>,
    aggregate: Kernel<aggregate::K>,
    match_right: Kernel<match_right::K>,
    match_left: Kernel<match_left::K>,
    verify: Kernel<verify::K>,
    speckle_join: Kernel<speckle_join::K>,
    speckle_count: Kernel<speckle_count::K>,
    speckle_drop: Kernel<speckle_drop::K>,
}

/// What is in the arena, for tests of single stages.
#[derive(Clone, Copy)]
pub struct Buffers {
    /// Both images, four pixels to a word.
    pub images: Buf<u32>,
    pub strings: Buf<u32>,
    pub sums: Buf<[u32; 4]>,
    pub right: Buf<u32>,
    pub disparity: Buf<f32>,
    pub deviation: Buf<f32>,
    pub labels: Buf<u32>,
    /// In the room of `sums`.
    pub areas: Buf<u32>,
    pub data: Buf<[f32; 2]>,
    pub medians: Buf<[f32; 2]>,
    pub ratios: Buf<f32>,
}

pub struct Sgm {
    shape: Shape,
    k: Kernels,
    b: Buffers,
    /// Paths a workgroup of `aggregate` walks.
    paths: u32,
    wls: Wls,
    /// Host side of the images.
    bytes: Vec<u8>,
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        let (plane, pixels) = (shape.plane(), shape.pixels());
        let image_words = image_bytes(shape.width, shape.height) / size_of::<u32>();
        let images = arena.alloc("sgm: images", 2 * image_words)?;
        let strings = arena.alloc("sgm: census strings", 2 * plane)?;
        let words: Buf<u32> = arena.alloc("sgm: disparities", 4 * plane)?;
        let sums: Buf<u32> = arena.alloc("sgm: sums", plane * shape.disparities as usize / 2)?;
        Ok(Buffers {
            images,
            strings,
            sums: sums.cast(),
            right: words.part(0, pixels),
            disparity: words.part(plane, pixels).cast(),
            deviation: words.part(2 * plane, pixels).cast(),
            labels: words.part(3 * plane, pixels),
            areas: sums.part(0, pixels),
            data: sums.part(plane, 2 * pixels).cast(),
            medians: sums.part(3 * plane, 2 * pixels).cast(),
            ratios: sums.part(5 * plane, pixels).cast(),
        })
    }
}

impl Sgm {
    pub fn new(gpu: &mut Gpu, buffers: Buffers, shape: Shape) -> Result<Sgm, Fault> {
        let group = if gpu.caps().kind == DeviceKind::Cpu { GROUP_CPU } else { GROUP_GPU };
        Sgm::with_group(gpu, buffers, shape, group)
    }

    /// Does what `new` does with about this many invocations a workgroup of `aggregate`; the result does not depend on it.
    pub fn with_group(gpu: &mut Gpu, buffers: Buffers, shape: Shape, group: u32) -> Result<Sgm, Fault> {
        let lanes = shape.disparities / RUN;
        let paths = (group / lanes).max(1);
        Ok(Sgm {
            k: Kernels {
                census: gpu.kernel_in_pieces(census::Spec::default())?,
                aggregate: gpu.kernel_in_pieces(aggregate::Spec { width: paths * lanes, lanes })?,
                match_right: gpu.kernel_in_pieces(match_right::Spec::default())?,
                match_left: gpu.kernel_in_pieces(match_left::Spec::default())?,
                verify: gpu.kernel_in_pieces(verify::Spec::default())?,
                speckle_join: gpu.kernel_in_pieces(speckle_join::Spec::default())?,
                speckle_count: gpu.kernel_in_pieces(speckle_count::Spec::default())?,
                speckle_drop: gpu.kernel_in_pieces(speckle_drop::Spec::default())?,
            },
            b: buffers,
            paths,
            wls: Wls::new(gpu)?,
            bytes: packed(shape.width, shape.height),
            shape,
        })
    }

    #[cfg(feature = "instruments")]
    pub fn buffers(&self) -> &Buffers {
        &self.b
    }

    /// Disparities of the left image, px, negative where unknown, and their standard deviation.
    pub fn compute(&mut self, gpu: &mut Gpu, left: &Image, right: &Image, out: &mut Disparity) -> Result<(), GpuError> {
        self.load(gpu, left, right)?;
        let rec = gpu.record();
        self.finish(gpu, rec, out)
    }

    /// Does what `compute` does with a raw pair.
    pub fn compute_raw(
        &mut self,
        gpu: &mut Gpu,
        rectifier: &mut Rectifier,
        [left, right]: [&Image; 2],
        out: &mut Disparity,
    ) -> Result<(), GpuError> {
        rectifier.load(gpu, left, right)?;
        let mut rec = gpu.record();
        rectifier.record(&mut rec, self.b.images);
        self.finish(gpu, rec, out)
    }

    fn finish(&self, gpu: &mut Gpu, mut rec: Recorder, out: &mut Disparity) -> Result<(), GpuError> {
        self.record_sums(&mut rec);
        self.record_matches(&mut rec);
        self.record_speckles(&mut rec);
        self.record_filter(&mut rec);
        gpu.submit(rec)?;
        gpu.download(self.b.disparity, 0, &mut out.px)?;
        gpu.download(self.b.deviation, 0, &mut out.sigma_px)
    }

    /// Copies the rectified pair to the GPU.
    pub fn load(&mut self, gpu: &mut Gpu, left: &Image, right: &Image) -> Result<(), GpuError> {
        pack(left, right, &mut self.bytes);
        gpu.upload(self.b.images.cast(), 0, &self.bytes)
    }

    /// Matching costs summed over all directions.
    pub fn record_sums(&self, rec: &mut Recorder) {
        let (k, b, s) = (&self.k, &self.b, &self.shape);
        let size = s.size();
        let strings = census::Bind { images: b.images.read(), strings: b.strings.write() };
        rec.dispatch(&k.census, strings, census::Push { size }, Threads::d3(size[0], size[1], 2));
        for (i, step) in DIRECTIONS.iter().take(s.paths as usize).enumerate() {
            let paths = if step[1] == 0 { size[1] } else { size[0] };
            rec.dispatch(
                &k.aggregate,
                aggregate::Bind { images: b.images.read(), strings: b.strings.read(), sums: b.sums.read_write() },
                aggregate::Push {
                    size,
                    step: *step,
                    outside: OUTSIDE,
                    p1: P1,
                    p2: P2,
                    p2_slope: P2_SLOPE,
                    p2_min: P2_MIN,
                    add: (i > 0).into(),
                },
                Threads::groups(paths.div_ceil(self.paths), 1, 1),
            );
        }
    }

    /// The least sums, where both eyes agree and nothing else is as good.
    pub fn record_matches(&self, rec: &mut Recorder) {
        let (k, b, s) = (&self.k, &self.b, &self.shape);
        let (size, disparities, each) = (s.size(), s.disparities, Threads::d1(s.pixels() as u32));
        let right = match_right::Bind { sums: b.sums.cast().read(), right: b.right.write() };
        rec.dispatch(&k.match_right, right, match_right::Push { size, disparities }, each);
        rec.dispatch(
            &k.match_left,
            match_left::Bind {
                sums: b.sums.read(),
                right: b.right.read(),
                disparity: b.disparity.write(),
                labels: b.labels.write(),
            },
            match_left::Push { size, disparities, unique: 100 - s.uniqueness_percent, disagree: DISAGREE },
            each,
        );
        rec.dispatch(
            &k.verify,
            verify::Bind { strings: b.strings.read(), disparity: b.disparity.read_write() },
            verify::Push { size, disparities, chance: CHANCE, fit: REPEAT_FIT, alike: REPEAT_ALIKE, wall: REPEAT_WALL },
            each,
        );
    }

    /// Drops what is left of small islands.
    pub fn record_speckles(&self, rec: &mut Recorder) {
        let (k, b, s) = (&self.k, &self.b, &self.shape);
        let (pixels, each) = (s.pixels() as u32, Threads::d1(s.pixels() as u32));
        rec.fill(b.areas, 0);
        rec.dispatch(
            &k.speckle_join,
            speckle_join::Bind { disparity: b.disparity.read(), labels: b.labels.read_write() },
            speckle_join::Push { size: s.size(), close: SPECKLE_CLOSE },
            each,
        );
        rec.dispatch(
            &k.speckle_count,
            speckle_count::Bind {
                disparity: b.disparity.read(),
                labels: b.labels.read_write(),
                areas: b.areas.read_write(),
            },
            speckle_count::Push { pixels },
            each,
        );
        rec.dispatch(
            &k.speckle_drop,
            speckle_drop::Bind { labels: b.labels.read(), areas: b.areas.read(), disparity: b.disparity.read_write() },
            speckle_drop::Push { pixels, area_min: SPECKLE_AREA },
            each,
        );
    }

    /// Fills and smooths where the shape says so, and settles the deviations.
    pub fn record_filter(&self, rec: &mut Recorder) {
        self.wls.record(rec, &self.b, self.shape.size(), self.shape.wls);
    }
}
