//! The images to train on, and how far a picture is from one: (1 - λ)|x - y| + λ(1 - SSIM) and its gradient by pixel.
//!
//! ```text
//! (fill_absent) -> ssim_tiles -> loss_tiles                                           picture -> gradient by pixel, channel by channel
//! on a CPU: ssim_rows -> ssim_columns -> loss_rows -> loss_columns
//! ```

use super::horizon::{Absent, COLUMNS, ROWS};
use super::shape::{Scratch, Shape, GROUP, LOSS_TILE, RUN};
use super::step::Target;
use crate::gpu::kernels::{fill_absent, loss_columns, loss_rows, loss_tiles, ssim_columns, ssim_rows, ssim_tiles};
use crate::gpu::{Arena, Buf, Gpu, GpuError, Kernel, Recorder, Threads};
use crate::limits::CAMERAS_MAX;
use stipple_drivers::Fault;

/// Transmittance above which a pixel of a view that the pool does not hold all of is not compared: most of it is absent.
const OPEN: f32 = 0.5;

// Columns of 64 px, in runs of 4: ssim_tile.glsl.
const _: () = assert!(LOSS_TILE[1] == ssim_tiles::LOCAL[0] / 64 * 4 && loss_tiles::LOCAL[0] == ssim_tiles::LOCAL[0]);

#[derive(Clone, Copy)]
pub struct Buffers {
    whole: Images,
    /// The same at half the size, where steps draw that.
    half: Option<Images>,
    /// By colour, plane by plane.
    pub pixel_gradient: Buf<f32>,
    pub ssim_sums: Buf<f32>,
    /// |x - y|, gradient by gain and by offset.
    pub loss_sums: Buf<[f32; 4]>,
}

/// The images to train on at one size.
#[derive(Clone, Copy)]
struct Images {
    shape: Shape,
    words: Buf<u32>,
    /// A mask for each camera, and one for a view of which something is absent.
    masks: Buf<u32>,
    /// Pixels that count, by camera.
    valid_pixels: [u32; CAMERAS_MAX],
}

impl Images {
    fn new(arena: &mut Arena, shape: Shape, [images, masks]: [&'static str; 2]) -> Result<Images, Fault> {
        Ok(Images {
            shape,
            words: arena.alloc(images, shape.image_words() * (shape.channels * shape.images) as usize)?,
            masks: arena.alloc(masks, (shape.cameras as usize + 1) * shape.mask_stride())?,
            valid_pixels: [0; CAMERAS_MAX],
        })
    }

    fn size(&self) -> [u32; 2] {
        [self.shape.width, self.shape.height]
    }

    fn mask(&self, target: &Target) -> Buf<u32> {
        self.nth_mask(if target.absent.is_some() { self.shape.cameras } else { target.camera })
    }

    fn nth_mask(&self, n: u32) -> Buf<u32> {
        self.masks.part(n as usize * self.shape.mask_stride(), self.shape.image_words())
    }

    /// Where a target's plane begins among the images, words.
    fn word_of(&self, target: &Target, channel: u32) -> u32 {
        (target.image * self.shape.channels + channel) * self.shape.image_words() as u32
    }

    fn rows(&self) -> Threads {
        Threads::d1(self.shape.width.div_ceil(RUN) * self.shape.height)
    }

    fn columns(&self) -> Threads {
        Threads::d1(self.shape.loss_runs())
    }

    fn tiles(&self) -> Threads {
        let [lanes, ..] = ssim_tiles::LOCAL;
        Threads::d1(self.shape.loss_tiles() * lanes)
    }
}

impl Buffers {
    pub fn new(arena: &mut Arena, shape: &Shape) -> Result<Buffers, Fault> {
        let groups = (shape.channels * shape.loss_tiles().max(shape.loss_runs().div_ceil(GROUP))) as usize;
        Ok(Buffers {
            whole: Images::new(arena, *shape, ["keyframes: images", "keyframes: masks"])?,
            half: (shape.halved())
                .map(|half| Images::new(arena, half, ["keyframes: images, half size", "keyframes: masks, half size"]))
                .transpose()?,
            pixel_gradient: arena.alloc("pixels: gradient", shape.channels as usize * shape.pixels())?,
            ssim_sums: arena.alloc("pixels: SSIM by workgroup", groups)?,
            loss_sums: arena.alloc("pixels: L1 and exposure gradient by workgroup", groups)?,
        })
    }
}

pub struct Loss {
    pub buffers: Buffers,
    filtered: Buf<f32>,
    slopes: Buf<f32>,
    /// An image on its way to the device, and one at half the size.
    words: Vec<u32>,
    halved: Vec<u8>,
    fill_absent: Kernel<fill_absent::K>,
    kernels: Kernels,
}

enum Kernels {
    /// Each pass along one direction, from registers: a CPU's shared memory is slow.
    ByRuns {
        ssim_rows: Kernel<ssim_rows::K>,
        ssim_columns: Kernel<ssim_columns::K>,
        ssim_map: Kernel<ssim_columns::K>,
        loss_rows: Kernel<loss_rows::K>,
        loss_columns: Kernel<loss_columns::K>,
    },
    /// Both directions in one, through shared memory.
    ByTiles { ssim: Kernel<ssim_tiles::K>, ssim_map: Kernel<ssim_tiles::K>, loss: Kernel<loss_tiles::K> },
}

impl Kernels {
    fn new(gpu: &mut Gpu, by_tiles: bool) -> Result<Kernels, Fault> {
        if by_tiles {
            return Ok(Kernels::ByTiles {
                ssim: gpu.kernel_in_pieces(ssim_tiles::Spec { map: 0 })?,
                ssim_map: gpu.kernel_in_pieces(ssim_tiles::Spec { map: 1 })?,
                loss: gpu.kernel_in_pieces(loss_tiles::Spec::default())?,
            });
        }
        Ok(Kernels::ByRuns {
            ssim_rows: gpu.kernel_in_pieces(ssim_rows::Spec::default())?,
            ssim_columns: gpu.kernel_in_pieces(ssim_columns::Spec { map: 0 })?,
            ssim_map: gpu.kernel_in_pieces(ssim_columns::Spec { map: 1 })?,
            loss_rows: gpu.kernel_in_pieces(loss_rows::Spec::default())?,
            loss_columns: gpu.kernel_in_pieces(loss_columns::Spec::default())?,
        })
    }
}

impl Loss {
    /// Every pixel counts until a mask is set.
    pub fn new(
        gpu: &mut Gpu,
        buffers: Buffers,
        scratch: &Scratch,
        shape: &Shape,
        by_tiles: bool,
    ) -> Result<Loss, Fault> {
        let mut loss = Loss {
            buffers,
            filtered: scratch.filtered,
            slopes: scratch.slopes,
            words: Vec::with_capacity(shape.image_words()),
            halved: Vec::with_capacity(shape.halved_pixels()),
            fill_absent: gpu.kernel_in_pieces(fill_absent::Spec::default())?,
            kernels: Kernels::new(gpu, by_tiles)?,
        };
        let all = vec![255; shape.pixels()];
        (0..shape.cameras as usize).try_for_each(|camera| loss.set_mask(gpu, camera, &all))?;
        Ok(loss)
    }

    /// Stores one channel of an image, and the same at half the size: row-major, stride = width.
    pub fn set_plane(&mut self, gpu: &mut Gpu, image: u32, channel: usize, plane: &[u8]) -> Result<(), GpuError> {
        let Buffers { whole, half, .. } = self.buffers;
        let at = image as usize * whole.shape.channels as usize + channel;
        pack(plane, &whole.shape, &mut self.words);
        gpu.upload(whole.words, at * whole.shape.image_words(), &self.words)?;
        if let Some(half) = half {
            halve(plane, whole.shape.width as usize, mean, &mut self.halved);
            pack(&self.halved, &half.shape, &mut self.words);
            gpu.upload(half.words, at * half.shape.image_words(), &self.words)?;
        }
        Ok(())
    }

    /// Stores an image, plane by plane.
    #[cfg(feature = "instruments")]
    pub fn set_image(&mut self, gpu: &mut Gpu, image: u32, planes: &[u8]) -> Result<(), GpuError> {
        let mut planes = planes.chunks_exact(self.buffers.whole.shape.pixels()).enumerate();
        planes.try_for_each(|(channel, plane)| self.set_plane(gpu, image, channel, plane))
    }

    /// Pixels that count, of every image of a camera: zero is ignored. At half the size those count that are of four that do.
    pub fn set_mask(&mut self, gpu: &mut Gpu, camera: usize, mask: &[u8]) -> Result<(), GpuError> {
        let Buffers { whole, half, .. } = &mut self.buffers;
        let valid = |mask: &[u8]| mask.iter().filter(|m| **m != 0).count() as u32;
        whole.valid_pixels[camera] = valid(mask);
        pack(mask, &whole.shape, &mut self.words);
        gpu.upload(whole.masks, camera * whole.shape.mask_stride(), &self.words)?;
        if let Some(half) = half {
            halve(mask, whole.shape.width as usize, least, &mut self.halved);
            half.valid_pixels[camera] = valid(&self.halved);
            pack(&self.halved, &half.shape, &mut self.words);
            gpu.upload(half.masks, camera * half.shape.mask_stride(), &self.words)?;
        }
        Ok(())
    }

    /// The images of a target's size.
    fn images(&self, target: &Target) -> &Images {
        let Buffers { whole, half, .. } = &self.buffers;
        half.as_ref().filter(|_| target.half_size).unwrap_or(whole)
    }

    /// How many values a target compares: valid pixels, each channel's.
    pub fn values(&self, target: &Target) -> f64 {
        let images = self.images(target);
        f64::from(images.valid_pixels[target.camera as usize].max(1) * images.shape.channels)
    }

    /// Workgroups that sum one channel.
    fn groups(&self, target: &Target) -> u32 {
        let shape = &self.images(target).shape;
        match self.kernels {
            Kernels::ByRuns { .. } => shape.loss_runs().div_ceil(GROUP),
            Kernels::ByTiles { .. } => shape.loss_tiles(),
        }
    }

    /// Sums of a step: those of each channel's workgroups.
    pub fn sums(&self, target: &Target) -> u32 {
        self.images(target).shape.channels * self.groups(target)
    }

    /// Channel by channel: each is an image of its own.
    pub fn record(&self, rec: &mut Recorder, rendered: Buf<f32>, target: &Target, ssim_weight: f32) {
        self.record_fill(rec, rendered, target);
        for channel in 0..self.images(target).shape.channels {
            self.record_ssim(rec, rendered, target, channel, false);
            self.record_loss(rec, rendered, target, channel, ssim_weight);
        }
    }

    fn record_loss(&self, rec: &mut Recorder, rendered: Buf<f32>, target: &Target, channel: u32, ssim_weight: f32) {
        let (b, images, values) = (&self.buffers, self.images(target), self.values(target) as f32);
        let (size, grey, targets) = (images.size(), rendered.read(), images.words.read());
        let mask = images.mask(target).read();
        let (grey_gradient, loss_sums) = (b.pixel_gradient.write(), b.loss_sums.write());
        let push = loss_tiles::Push {
            size,
            target: images.word_of(target, channel),
            plane: channel * size[0] * size[1],
            group: channel * self.groups(target),
            exposure: target.exposure.words(),
            l1_weight: (1.0 - ssim_weight) / values,
            ssim_weight: ssim_weight / values,
        };
        match &self.kernels {
            Kernels::ByRuns { loss_rows, loss_columns, .. } => {
                let along = loss_rows::Bind { slopes: self.slopes.read(), filtered: self.filtered.write() };
                rec.dispatch(loss_rows, along, loss_rows::Push { size }, images.rows());
                let filtered = self.filtered.read();
                let bind = loss_columns::Bind { filtered, grey, targets, mask, grey_gradient, loss_sums };
                rec.dispatch(loss_columns, bind, bytemuck::cast(push), images.columns());
            }
            Kernels::ByTiles { loss, .. } => {
                let slopes = self.slopes.read();
                let bind = loss_tiles::Bind { slopes, grey, targets, mask, grey_gradient, loss_sums };
                rec.dispatch(loss, bind, push, images.tiles());
            }
        }
    }

    /// SSIM by pixel of a picture against an image, mean of its channels; one where masked. `map` has room for them all. Fills the
    /// picture where something is absent: once for a picture.
    pub fn similarity(
        &self,
        gpu: &mut Gpu,
        rendered: Buf<f32>,
        target: &Target,
        map: &mut Vec<f32>,
    ) -> Result<(), GpuError> {
        let shape = &self.images(target).shape;
        let (n, channels) = (shape.pixels(), shape.channels);
        map.resize(n * channels as usize, 1.0);
        for (channel, plane) in map.chunks_exact_mut(n).enumerate() {
            let mut rec = gpu.record();
            if channel == 0 {
                self.record_fill(&mut rec, rendered, target);
            }
            self.record_ssim(&mut rec, rendered, target, channel as u32, true);
            gpu.submit(rec)?;
            gpu.download(self.slopes, 0, plane)?;
        }
        if channels > 1 {
            (0..n).for_each(|i| map[i] = map[i..].iter().step_by(n).sum::<f32>() / channels as f32);
            map.truncate(n);
        }
        Ok(())
    }

    /// Slopes of SSIM and its sums, or with `map` SSIM by pixel in place of the slopes.
    fn record_ssim(&self, rec: &mut Recorder, rendered: Buf<f32>, target: &Target, channel: u32, map: bool) {
        let images = self.images(target);
        let (size, grey, targets) = (images.size(), rendered.read(), images.words.read());
        let (mask, slopes, ssim_sums) =
            (images.mask(target).read(), self.slopes.write(), self.buffers.ssim_sums.write());
        let (word, plane, exposure) =
            (images.word_of(target, channel), channel * size[0] * size[1], target.exposure.words());
        let group = if map { 0 } else { channel * self.groups(target) };
        match &self.kernels {
            Kernels::ByRuns { ssim_rows, ssim_columns, ssim_map, .. } => {
                let along = ssim_rows::Bind { grey, targets, mask, filtered: self.filtered.write() };
                rec.dispatch(ssim_rows, along, ssim_rows::Push { size, target: word, plane, exposure }, images.rows());
                let across = ssim_columns::Bind { filtered: self.filtered.read(), mask, slopes, ssim_sums };
                let columns = if map { ssim_map } else { ssim_columns };
                rec.dispatch(columns, across, ssim_columns::Push { size, group }, images.columns());
            }
            Kernels::ByTiles { ssim, ssim_map, .. } => {
                let bind = ssim_tiles::Bind { grey, targets, mask, slopes, ssim_sums };
                let push = ssim_tiles::Push { size, target: word, plane, group, exposure };
                rec.dispatch(if map { ssim_map } else { ssim }, bind, push, images.tiles());
            }
        }
    }

    /// Makes the mask of a target of which something is absent, and puts its image behind the picture there. Once for a picture.
    fn record_fill(&self, rec: &mut Recorder, rendered: Buf<f32>, target: &Target) {
        let Some(Absent { hidden, filled }) = target.absent else { return };
        let images = self.images(target);
        rec.dispatch(
            &self.fill_absent,
            fill_absent::Bind {
                mask: images.nth_mask(target.camera).read(),
                targets: images.words.read(),
                picture: rendered.read_write(),
                masked: images.mask(target).write(),
            },
            fill_absent::Push {
                size: images.size(),
                grid: [COLUMNS as u32, ROWS as u32],
                hidden: hidden.0,
                filled: filled.0,
                target: images.word_of(target, 0),
                channels: images.shape.channels,
                open: OPEN,
                exposure: target.exposure.words(),
            },
            Threads::d1(images.shape.image_words() as u32),
        );
    }
}

/// Words of four pixels, rows padded to whole words.
fn pack(image: &[u8], shape: &Shape, words: &mut Vec<u32>) {
    assert_eq!(image.len(), shape.pixels(), "images are of the shape the map was made with");
    words.clear();
    for row in image.chunks_exact(shape.width as usize) {
        words.extend(row.chunks(4).map(|c| {
            let mut b = [0; 4];
            b[..c.len()].copy_from_slice(c);
            u32::from_le_bytes(b)
        }));
    }
}

/// Writes an image at half the size into `half`: `one_of` makes one pixel of two by two; an odd row or column is left off.
fn halve(image: &[u8], width: usize, one_of: fn([u8; 4]) -> u8, half: &mut Vec<u8>) {
    half.clear();
    for rows in image.chunks_exact(2 * width) {
        let (above, below) = rows.split_at(width);
        let pairs = above.chunks_exact(2).zip(below.chunks_exact(2));
        half.extend(pairs.map(|(a, b)| one_of([a[0], a[1], b[0], b[1]])));
    }
}

fn mean(four: [u8; 4]) -> u8 {
    ((four.iter().map(|v| u32::from(*v)).sum::<u32>() + 2) / 4) as u8
}

fn least(four: [u8; 4]) -> u8 {
    four.into_iter().min().unwrap_or(0)
}
