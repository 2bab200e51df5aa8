//! The structures, ioctl numbers and flags of `linux/videodev2.h` that a camera needs. Sizes and offsets are those of 64-bit
//! little-endian Linux and are asserted; where the header has a union, the member that is used is declared and the rest is
//! padding (arrays in arrays, as `Default` ends at 32 items). Documentation: kernel.org, "Video for Linux API", by the same
//! names.

/// Capture buffers of one plane and of several (`V4L2_BUF_TYPE_VIDEO_CAPTURE`, `.._MPLANE`).
pub const CAPTURE: u32 = 1;
pub const CAPTURE_MULTI: u32 = 9;
pub const MEMORY_MMAP: u32 = 1;
pub const FIELD_NONE: u32 = 1;
/// Most planes of a picture (`VIDEO_MAX_PLANES`).
pub const PLANES_MAX: usize = 8;

pub const CAP_CAPTURE: u32 = 0x1;
pub const CAP_CAPTURE_MULTI: u32 = 0x1000;
pub const CAP_STREAMING: u32 = 0x0400_0000;
pub const CAP_DEVICE_CAPS: u32 = 0x8000_0000;
/// Flag of `StreamParm::capability`: the driver can be asked for a rate.
pub const CAP_TIME_PER_FRAME: u32 = 0x1000;

pub const BUFFER_ERROR: u32 = 0x40;
pub const STAMP_MASK: u32 = 0xe000;
pub const STAMP_MONOTONIC: u32 = 0x2000;
pub const STAMP_COPY: u32 = 0x4000;
pub const STAMP_SOURCE_MASK: u32 = 0x7_0000;
pub const STAMP_SOURCE_EXPOSURE: u32 = 0x1_0000;

pub const SIZE_DISCRETE: u32 = 1;

/// `QueryControl::id` with this asks for the next control after it.
pub const NEXT_CONTROL: u32 = 0x8000_0000;
pub const CONTROL_DISABLED: u32 = 0x1;
pub const CONTROL_READ_ONLY: u32 = 0x4;
pub const CONTROL_INTEGER: u32 = 1;
pub const CONTROL_BOOLEAN: u32 = 2;
pub const CONTROL_MENU: u32 = 3;
pub const CONTROL_INTEGER64: u32 = 5;
pub const CONTROL_BITMASK: u32 = 8;
pub const CONTROL_INTEGER_MENU: u32 = 9;
pub const CID_EXPOSURE: u32 = 0x0098_0911;
pub const CID_EXPOSURE_AUTO: u32 = 0x009a_0901;
pub const CID_EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
/// Value of `CID_EXPOSURE_AUTO` that lets us set the exposure.
pub const EXPOSURE_MANUAL: i64 = 1;

pub const QUERYCAP: u32 = read::<Capability>(0);
pub const ENUM_FMT: u32 = both::<FormatDescription>(2);
pub const S_FMT: u32 = both::<FormatSingle>(5);
pub const REQBUFS: u32 = both::<RequestBuffers>(8);
pub const QUERYBUF: u32 = both::<Buffer>(9);
pub const QBUF: u32 = both::<Buffer>(15);
pub const DQBUF: u32 = both::<Buffer>(17);
pub const STREAMON: u32 = write::<u32>(18);
pub const STREAMOFF: u32 = write::<u32>(19);
pub const S_PARM: u32 = both::<StreamParm>(22);
pub const G_EXT_CTRLS: u32 = both::<ExtControls>(71);
pub const S_EXT_CTRLS: u32 = both::<ExtControls>(72);
pub const ENUM_FRAMESIZES: u32 = both::<FrameSize>(74);
pub const ENUM_FRAMEINTERVALS: u32 = both::<FrameInterval>(75);
pub const QUERY_EXT_CTRL: u32 = both::<QueryControl>(103);

const fn number(direction: u32, size: usize, nr: u32) -> u32 {
    direction << 30 | (size as u32) << 16 | (b'V' as u32) << 8 | nr
}
const fn write<T>(nr: u32) -> u32 {
    number(1, size_of::<T>(), nr)
}
const fn read<T>(nr: u32) -> u32 {
    number(2, size_of::<T>(), nr)
}
const fn both<T>(nr: u32) -> u32 {
    number(3, size_of::<T>(), nr)
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct Capability {
    pub driver: [u8; 16],
    pub card: [u8; 32],
    pub bus_info: [u8; 32],
    pub version: u32,
    pub capabilities: u32,
    pub device_caps: u32,
    pub reserved: [u32; 3],
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct FormatDescription {
    pub index: u32,
    pub kind: u32,
    pub flags: u32,
    pub description: [u8; 32],
    pub fourcc: u32,
    pub mbus_code: u32,
    pub reserved: [u32; 3],
}

/// `extent` is width and height where discrete; else least, most and step of the width, then of the height.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct FrameSize {
    pub index: u32,
    pub fourcc: u32,
    pub kind: u32,
    pub extent: [u32; 6],
    pub reserved: [u32; 2],
}

/// `interval` is numerator, denominator of seconds where discrete; else least, most and step.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct FrameInterval {
    pub index: u32,
    pub fourcc: u32,
    pub width: u32,
    pub height: u32,
    pub kind: u32,
    pub interval: [u32; 6],
    pub reserved: [u32; 2],
}

/// `v4l2_format` of a single-planar queue.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(8))]
pub struct FormatSingle {
    pub kind: u32,
    pub padding: u32,
    pub width: u32,
    pub height: u32,
    pub fourcc: u32,
    pub field: u32,
    pub bytes_per_line: u32,
    pub size_image: u32,
    pub rest: [[u32; 11]; 4],
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct PlaneFormat {
    pub size_image: u32,
    pub bytes_per_line: u32,
    pub reserved: [u16; 6],
}

/// `v4l2_format` of a multi-planar queue.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(8))]
pub struct FormatMulti {
    pub kind: u32,
    pub padding: u32,
    pub width: u32,
    pub height: u32,
    pub fourcc: u32,
    pub field: u32,
    pub colorspace: u32,
    pub planes: [PlaneFormat; PLANES_MAX],
    pub num_planes: u8,
    pub rest: [u8; 19],
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct StreamParm {
    pub kind: u32,
    pub capability: u32,
    pub capture_mode: u32,
    /// Seconds a frame.
    pub numerator: u32,
    pub denominator: u32,
    pub rest: [[u32; 23]; 2],
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct RequestBuffers {
    pub count: u32,
    pub kind: u32,
    pub memory: u32,
    pub capabilities: u32,
    pub flags: u32,
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct Buffer {
    pub index: u32,
    pub kind: u32,
    pub bytes_used: u32,
    pub flags: u32,
    pub field: u32,
    pub stamp_s: i64,
    pub stamp_us: i64,
    pub timecode: [u32; 4],
    pub sequence: u32,
    pub memory: u32,
    /// Offset to map (the low half), or the address of the planes.
    pub place: u64,
    /// Bytes, or the number of planes.
    pub length: u32,
    pub reserved: u32,
    pub request_fd: i32,
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct Plane {
    pub bytes_used: u32,
    pub length: u32,
    pub place: u64,
    pub data_offset: u32,
    pub reserved: [u32; 11],
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C, packed(4))]
pub struct ExtControl {
    pub id: u32,
    pub size: u32,
    pub reserved: u32,
    /// In the low half where the control has 32 bits.
    pub value: i64,
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct ExtControls {
    pub which: u32,
    pub count: u32,
    pub error_index: u32,
    pub request_fd: i32,
    pub reserved: u32,
    /// Address of `ExtControl`s.
    pub controls: u64,
}

#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub struct QueryControl {
    pub id: u32,
    pub kind: u32,
    pub name: [u8; 32],
    pub minimum: i64,
    pub maximum: i64,
    pub step: u64,
    pub default: i64,
    pub flags: u32,
    pub elem_size: u32,
    pub elems: u32,
    pub nr_of_dims: u32,
    pub dims: [u32; 4],
    pub reserved: [u32; 32],
}

/// Layouts as a C compiler on 64-bit Linux gives them; `place` and `ExtControl::value` take the low half first.
const _: () = {
    assert!(cfg!(all(target_pointer_width = "64", target_endian = "little")));
    assert!(size_of::<Capability>() == 104);
    assert!(size_of::<FormatDescription>() == 64);
    assert!(size_of::<FrameSize>() == 44);
    assert!(size_of::<FrameInterval>() == 52);
    assert!(size_of::<FormatSingle>() == 208);
    assert!(size_of::<FormatMulti>() == 208);
    assert!(std::mem::offset_of!(FormatMulti, num_planes) == 8 + 180);
    assert!(size_of::<StreamParm>() == 204);
    assert!(size_of::<RequestBuffers>() == 20);
    assert!(size_of::<Buffer>() == 88);
    assert!(std::mem::offset_of!(Buffer, stamp_s) == 24);
    assert!(std::mem::offset_of!(Buffer, sequence) == 56);
    assert!(std::mem::offset_of!(Buffer, place) == 64);
    assert!(size_of::<Plane>() == 64);
    assert!(size_of::<ExtControl>() == 20);
    assert!(size_of::<ExtControls>() == 32);
    assert!(size_of::<QueryControl>() == 232);
    // What the header's macros give.
    assert!(QUERYCAP == 0x8068_5600 && ENUM_FMT == 0xc040_5602 && S_FMT == 0xc0d0_5605 && REQBUFS == 0xc014_5608);
    assert!(QUERYBUF == 0xc058_5609 && QBUF == 0xc058_560f && DQBUF == 0xc058_5611);
    assert!(STREAMON == 0x4004_5612 && STREAMOFF == 0x4004_5613 && S_PARM == 0xc0cc_5616);
    assert!(G_EXT_CTRLS == 0xc020_5647);
    assert!(S_EXT_CTRLS == 0xc020_5648 && ENUM_FRAMESIZES == 0xc02c_564a && ENUM_FRAMEINTERVALS == 0xc034_564b);
    assert!(QUERY_EXT_CTRL == 0xc0e8_5667);
};
