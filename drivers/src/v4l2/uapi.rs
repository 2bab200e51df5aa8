//! The structures, ioctl numbers and flags of `linux/videodev2.h` that a camera needs. Sizes and offsets are those of 64-bit
//! little-endian Linux and are asserted; where the header has a union, the member that is used is declared and the rest is
//! padding (arrays in arrays, as `Default` ends at 32 items). Documentation: kernel.org, "Video for Linux API", by the same
//! names.

/// Capture buffers of one plane and of several (`V4L2_BUF_TYPE_VIDEO_CAPTURE`, `.._MPLANE`).
pub(super) const CAPTURE: u32 = 1;
pub(super) const CAPTURE_MULTI: u32 = 9;
pub(super) const MEMORY_MMAP: u32 = 1;
pub(super) const FIELD_NONE: u32 = 1;
/// `V4L2_PIX_FMT_PRIV_MAGIC`.
pub(super) const FORMAT_EXTENDED: u32 = 0xfeed_cafe;
/// Most planes of a picture (`VIDEO_MAX_PLANES`).
pub(super) const PLANES_MAX: usize = 8;

pub(super) const CAP_CAPTURE: u32 = 0x1;
pub(super) const CAP_CAPTURE_MULTI: u32 = 0x1000;
pub(super) const CAP_STREAMING: u32 = 0x0400_0000;
pub(super) const CAP_DEVICE_CAPS: u32 = 0x8000_0000;
/// Flag of `StreamParm::capability`: the driver can be asked for a rate.
pub(super) const CAP_TIME_PER_FRAME: u32 = 0x1000;

pub(super) const BUFFER_ERROR: u32 = 0x40;
pub(super) const STAMP_MASK: u32 = 0xe000;
pub(super) const STAMP_MONOTONIC: u32 = 0x2000;
pub(super) const STAMP_COPY: u32 = 0x4000;
pub(super) const STAMP_SOURCE_MASK: u32 = 0x7_0000;
pub(super) const STAMP_SOURCE_EXPOSURE: u32 = 0x1_0000;

pub(super) const SIZE_DISCRETE: u32 = 1;

/// `QueryControl::id` with this asks for the next control after it.
pub(super) const NEXT_CONTROL: u32 = 0x8000_0000;
pub(super) const CONTROL_DISABLED: u32 = 0x1;
pub(super) const CONTROL_READ_ONLY: u32 = 0x4;
/// The value changes by itself.
pub(super) const CONTROL_VOLATILE: u32 = 0x80;
pub(super) const CONTROL_INTEGER: u32 = 1;
pub(super) const CONTROL_INTEGER64: u32 = 5;
/// Kinds whose value is a number: these two, BOOLEAN, MENU, BITMASK and INTEGER_MENU.
pub(super) const CONTROL_NUMBERS: [u32; 6] = [CONTROL_INTEGER, CONTROL_INTEGER64, 2, 3, 8, 9];
pub(super) const CID_EXPOSURE: u32 = 0x0098_0911;
pub(super) const CID_EXPOSURE_AUTO: u32 = 0x009a_0901;
pub(super) const CID_EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
/// Values of `CID_EXPOSURE_AUTO` with which the exposure is what it is set to: set by us, and with an automatic aperture.
pub(super) const EXPOSURE_MANUAL: i64 = 1;
pub(super) const EXPOSURE_SHUTTER_PRIORITY: i64 = 2;

/// Event that a control was changed, and that its value was (`V4L2_EVENT_CTRL`, `.._CH_VALUE`).
pub(super) const EVENT_CONTROL: u32 = 3;
pub(super) const EVENT_CONTROL_VALUE: u32 = 0x1;

pub(super) const QUERYCAP: u32 = read::<Capability>(0);
pub(super) const ENUM_FMT: u32 = both::<FormatDescription>(2);
pub(super) const S_FMT: u32 = both::<FormatSingle>(5);
pub(super) const REQBUFS: u32 = both::<RequestBuffers>(8);
pub(super) const QUERYBUF: u32 = both::<Buffer>(9);
pub(super) const QBUF: u32 = both::<Buffer>(15);
pub(super) const DQBUF: u32 = both::<Buffer>(17);
pub(super) const STREAMON: u32 = write::<u32>(18);
pub(super) const STREAMOFF: u32 = write::<u32>(19);
pub(super) const S_PARM: u32 = both::<StreamParm>(22);
pub(super) const G_EXT_CTRLS: u32 = both::<ExtControls>(71);
pub(super) const S_EXT_CTRLS: u32 = both::<ExtControls>(72);
pub(super) const ENUM_FRAMESIZES: u32 = both::<FrameSize>(74);
pub(super) const ENUM_FRAMEINTERVALS: u32 = both::<FrameInterval>(75);
pub(super) const DQEVENT: u32 = read::<Event>(89);
pub(super) const SUBSCRIBE_EVENT: u32 = write::<EventSubscription>(90);
pub(super) const QUERY_EXT_CTRL: u32 = both::<QueryControl>(103);

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

/// Declares structures of the header, laid out as in C.
macro_rules! structures {
    ($($(#[$meta:meta])* $name:ident { $($(#[$about:meta])* $field:ident: $of:ty,)+ })+) => {$(
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, Default)]
        #[repr(C)]
        pub(super) struct $name {
            $($(#[$about])* pub(super) $field: $of,)+
        }
    )+};
}

structures! {
    Capability {
        driver: [u8; 16], card: [u8; 32], bus_info: [u8; 32], version: u32,
        capabilities: u32, device_caps: u32, reserved: [u32; 3],
    }

    FormatDescription {
        index: u32, kind: u32, flags: u32, description: [u8; 32], fourcc: u32, mbus_code: u32, reserved: [u32; 3],
    }

    /// `extent` is width and height where discrete; else least, most and step of the width, then of the height.
    FrameSize {
        index: u32, fourcc: u32, kind: u32, extent: [u32; 6], reserved: [u32; 2],
    }

    /// `interval` is numerator, denominator of seconds where discrete; else least, most and step.
    FrameInterval {
        index: u32, fourcc: u32, width: u32, height: u32, kind: u32, interval: [u32; 6], reserved: [u32; 2],
    }

    /// `v4l2_format` of a single-planar queue.
    #[repr(align(8))]
    FormatSingle {
        kind: u32, padding: u32, width: u32, height: u32, fourcc: u32, field: u32,
        bytes_per_line: u32, size_image: u32, colorspace: u32,
        /// `FORMAT_EXTENDED`: the fields after it are meant.
        private: u32,
        flags: u32, encoding: u32, quantization: u32, rest: [[u32; 13]; 3],
    }

    PlaneFormat {
        size_image: u32, bytes_per_line: u32, reserved: [u16; 6],
    }

    /// `v4l2_format` of a multi-planar queue.
    #[repr(align(8))]
    FormatMulti {
        kind: u32, padding: u32, width: u32, height: u32, fourcc: u32, field: u32, colorspace: u32,
        planes: [PlaneFormat; PLANES_MAX], num_planes: u8, flags: u8, encoding: u8, quantization: u8, rest: [u8; 16],
    }

    /// The interval from frame to frame is `numerator` / `denominator` seconds.
    StreamParm {
        kind: u32, capability: u32, capture_mode: u32, numerator: u32, denominator: u32, rest: [[u32; 23]; 2],
    }

    RequestBuffers {
        count: u32, kind: u32, memory: u32, capabilities: u32, flags: u32,
    }

    Buffer {
        index: u32, kind: u32, bytes_used: u32, flags: u32, field: u32, stamp_s: i64, stamp_us: i64,
        timecode: [u32; 4], sequence: u32, memory: u32,
        /// Offset to map (the low half), or the address of the planes.
        place: u64,
        /// Bytes, or the number of planes.
        length: u32,
        reserved: u32, request_fd: i32,
    }

    Plane {
        bytes_used: u32, length: u32, place: u64, data_offset: u32, reserved: [u32; 11],
    }

    /// `value` is in the low half where the control has 32 bits.
    #[repr(packed(4))]
    ExtControl {
        id: u32, size: u32, reserved: u32, value: i64,
    }

    /// `controls` is the address of `count` structures `ExtControl`.
    ExtControls {
        which: u32, count: u32, error_index: u32, request_fd: i32, reserved: u32, controls: u64,
    }

    EventSubscription {
        kind: u32, id: u32, flags: u32, reserved: [u32; 5],
    }

    /// `v4l2_event` of a control: what changed of it, its kind, its value (in the low half where it has 32 bits).
    Event {
        kind: u32, padding: u32, changes: u32, control_kind: u32, value: i64, rest: [u32; 12],
        pending: u32, sequence: u32, stamp_s: i64, stamp_ns: i64, id: u32, reserved: [u32; 9],
    }

    QueryControl {
        id: u32, kind: u32, name: [u8; 32], minimum: i64, maximum: i64, step: u64, default: i64, flags: u32,
        elem_size: u32, elems: u32, nr_of_dims: u32, dims: [u32; 4], reserved: [u32; 32],
    }
}

impl QueryControl {
    /// The number of a value, of which only the low half is written where a control has 32 bits.
    pub(super) fn number(&self, value: i64) -> i64 {
        if self.kind == CONTROL_INTEGER64 {
            value
        } else {
            i64::from(value as i32)
        }
    }
}

/// Layouts as a C compiler on 64-bit Linux gives them; `place` and `ExtControl::value` take the low half first. Numbers of
/// ioctls hold the size of their structure.
const _: () = {
    assert!(cfg!(all(target_pointer_width = "64", target_endian = "little")));
    assert!(size_of::<FormatMulti>() == 208 && size_of::<FormatSingle>() == 208);
    assert!(std::mem::offset_of!(FormatSingle, encoding) == 8 + 36);
    assert!(std::mem::offset_of!(FormatMulti, num_planes) == 8 + 180);
    assert!(std::mem::offset_of!(Buffer, stamp_s) == 24);
    assert!(std::mem::offset_of!(Buffer, sequence) == 56);
    assert!(std::mem::offset_of!(Buffer, place) == 64);
    assert!(size_of::<Plane>() == 64);
    assert!(size_of::<ExtControl>() == 20);
    assert!(std::mem::offset_of!(Event, stamp_s) == 80 && std::mem::offset_of!(Event, id) == 96);
    // What the header's macros give.
    assert!(QUERYCAP == 0x8068_5600 && ENUM_FMT == 0xc040_5602 && S_FMT == 0xc0d0_5605 && REQBUFS == 0xc014_5608);
    assert!(QUERYBUF == 0xc058_5609 && QBUF == 0xc058_560f && DQBUF == 0xc058_5611);
    assert!(STREAMON == 0x4004_5612 && STREAMOFF == 0x4004_5613 && S_PARM == 0xc0cc_5616);
    assert!(G_EXT_CTRLS == 0xc020_5647);
    assert!(S_EXT_CTRLS == 0xc020_5648 && ENUM_FRAMESIZES == 0xc02c_564a && ENUM_FRAMEINTERVALS == 0xc034_564b);
    assert!(QUERY_EXT_CTRL == 0xc0e8_5667 && DQEVENT == 0x8088_5659 && SUBSCRIBE_EVENT == 0x4020_565a);
};
