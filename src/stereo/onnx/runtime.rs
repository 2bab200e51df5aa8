//! ONNX Runtime by its C API, loaded when a board names a model: one session, two inputs, one output.
//!
//! The API is a table of functions whose order only ever grows at its end (onnxruntime_c_api.h, "add new functions
//! at the end"), so the places of the nineteen used here hold for every version since 1.0. Bound by hand: the crate
//! for it has been a release candidate for years, and each candidate refuses all but the newest runtimes.
#![allow(unsafe_code)]

use std::ffi::{c_char, c_int, c_void, CStr, CString};
use std::ptr::{null, null_mut};

/// The lowest version of the API that has all that is used.
const API_VERSION: u32 = 1;
const WARNING: c_int = 2;
const FLOAT: c_int = 1;
const DEVICE_ALLOCATOR: c_int = 0;
const DEFAULT_MEMORY: c_int = 0;

type Status = *mut c_void;
type Release = unsafe extern "C" fn(*mut c_void);
type Make = unsafe extern "C" fn(*mut *mut c_void) -> Status;

#[repr(C)]
struct ApiBase {
    get_api: unsafe extern "C" fn(u32) -> *const *const c_void,
    version: unsafe extern "C" fn() -> *const c_char,
}

/// What is used of the table, with each one's place in it.
#[derive(Clone, Copy)]
struct Api {
    error_message: unsafe extern "C" fn(Status) -> *const c_char,
    create_env: unsafe extern "C" fn(c_int, *const c_char, *mut *mut c_void) -> Status,
    create_session: unsafe extern "C" fn(*mut c_void, *const c_char, *mut c_void, *mut *mut c_void) -> Status,
    run: unsafe extern "C" fn(
        *mut c_void,
        *const c_void,
        *const *const c_char,
        *const *mut c_void,
        usize,
        *const *const c_char,
        usize,
        *mut *mut c_void,
    ) -> Status,
    create_options: Make,
    set_threads: unsafe extern "C" fn(*mut c_void, c_int) -> Status,
    create_tensor:
        unsafe extern "C" fn(*const c_void, *mut c_void, usize, *const i64, usize, c_int, *mut *mut c_void) -> Status,
    tensor_data: unsafe extern "C" fn(*mut c_void, *mut *mut c_void) -> Status,
    element_type: unsafe extern "C" fn(*mut c_void, *mut c_int) -> Status,
    element_count: unsafe extern "C" fn(*mut c_void, *mut usize) -> Status,
    type_and_shape: unsafe extern "C" fn(*mut c_void, *mut *mut c_void) -> Status,
    create_memory: unsafe extern "C" fn(c_int, c_int, *mut *mut c_void) -> Status,
    release_env: Release,
    release_status: Release,
    release_memory: Release,
    release_session: Release,
    release_value: Release,
    release_shape: Release,
    release_options: Release,
}

impl Api {
    /// # Safety
    /// `table` is a table of the C API.
    unsafe fn at(table: *const *const c_void) -> Api {
        // SAFETY: each place of the table holds a function of the type written for it above, by onnxruntime_c_api.h.
        unsafe fn f<F: Copy>(table: *const *const c_void, place: usize) -> F {
            // SAFETY: as promised by the caller; functions and data pointers have one size here.
            unsafe { std::mem::transmute_copy(&*table.add(place)) }
        }
        // SAFETY: as above.
        unsafe {
            Api {
                error_message: f(table, 2),
                create_env: f(table, 3),
                create_session: f(table, 7),
                run: f(table, 9),
                create_options: f(table, 10),
                set_threads: f(table, 24),
                create_tensor: f(table, 49),
                tensor_data: f(table, 51),
                element_type: f(table, 60),
                element_count: f(table, 64),
                type_and_shape: f(table, 65),
                create_memory: f(table, 69),
                release_env: f(table, 92),
                release_status: f(table, 93),
                release_memory: f(table, 94),
                release_session: f(table, 95),
                release_value: f(table, 96),
                release_shape: f(table, 99),
                release_options: f(table, 100),
            }
        }
    }

    fn check(&self, status: Status) -> Result<(), String> {
        if status.is_null() {
            return Ok(());
        }
        // SAFETY: a status that is not null is an error with a message, ours to release once it is copied.
        unsafe {
            let text = CStr::from_ptr((self.error_message)(status)).to_string_lossy().replace('\n', " ");
            (self.release_status)(status);
            Err(text)
        }
    }
}

/// Something of the runtime's, given back when dropped.
struct Held(*mut c_void, Release);

impl Held {
    fn make(api: &Api, release: Release, make: impl FnOnce(*mut *mut c_void) -> Status) -> Result<Held, String> {
        let mut made = null_mut();
        api.check(make(&mut made))?;
        Ok(Held(made, release))
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        if !self.0.is_null() {
            // SAFETY: made by the runtime, of the kind that `1` releases, and dropped once.
            unsafe { (self.1)(self.0) }
        }
    }
}

/// A model ready to run. Fields are dropped in order: what was made last goes first.
pub struct Session {
    inputs: [Held; 2],
    session: Held,
    _memory: Held,
    _env: Held,
    api: Api,
    names: [CString; 3],
    /// What the inputs' tensors point to.
    values: [Vec<f32>; 2],
}

// SAFETY: a session may be used from any thread, one at a time (`&mut self`); it has no affinity.
unsafe impl Send for Session {}

/// The table of the library at `path`, or why there is none.
fn load(path: &str) -> Result<(Api, String), String> {
    // SAFETY: a library that loads stays loaded for the life of the program. OrtGetApiBase is the entry point that ONNX
    // Runtime documents, of this signature, and answers a pointer to a static.
    unsafe {
        let library = libloading::Library::new(path).map_err(|why| why.to_string().replace('\n', " "))?;
        let library = std::mem::ManuallyDrop::new(library);
        let entry = library.get::<unsafe extern "C" fn() -> *const ApiBase>(b"OrtGetApiBase\0");
        let entry = entry.map_err(|_| "it has no OrtGetApiBase: not ONNX Runtime")?;
        let base = entry();
        let version = CStr::from_ptr(((*base).version)()).to_string_lossy().into_owned();
        let table = ((*base).get_api)(API_VERSION);
        match table.is_null() {
            true => Err(format!("version {version} has no C API {API_VERSION}")),
            false => Ok((Api::at(table), version)),
        }
    }
}

/// Why there is no session: no library, or a model that it refuses.
pub enum Refused {
    Library(String),
    Model(String),
}

/// Where the loader looks; Debian's name first.
const LIBRARIES: [&str; 2] = ["libonnxruntime.so.1", "libonnxruntime.so"];

impl Session {
    /// Opens a model with inputs `names[0]` and `names[1]` of `shape` and output `names[2]`. `runtime` is a library's
    /// path, or empty.
    pub fn open(
        runtime: &str,
        model: &str,
        names: [&str; 3],
        shape: [usize; 4],
        threads: u32,
    ) -> Result<Session, Refused> {
        let found = match runtime {
            "" => LIBRARIES.iter().map(|l| load(l)).reduce(|a, b| a.or(b)).unwrap_or_else(|| Err(String::new())),
            path => load(path),
        };
        let (api, _) = found.map_err(Refused::Library)?;
        Session::with(api, model, names, shape, threads).map_err(Refused::Model)
    }

    fn with(api: Api, model: &str, names: [&str; 3], shape: [usize; 4], threads: u32) -> Result<Session, String> {
        let text = |s: &str| CString::new(s).map_err(|_| "a name holds a zero".to_string());
        let names = [text(names[0])?, text(names[1])?, text(names[2])?];
        let model = text(model)?;
        let elements = shape.iter().product::<usize>();
        let dimensions = shape.map(|n| n as i64);
        let mut values = [vec![0f32; elements], vec![0f32; elements]];
        // SAFETY: every pointer is of a live object of the kind that the function wants; the runtime copies names and
        // options. Tensors keep a pointer to `values`, whose heap blocks outlive them and are never resized.
        unsafe {
            let env = Held::make(&api, api.release_env, |e| (api.create_env)(WARNING, c"stipple".as_ptr(), e))?;
            let options = Held::make(&api, api.release_options, |o| (api.create_options)(o))?;
            api.check((api.set_threads)(options.0, threads as c_int))?;
            let session =
                Held::make(&api, api.release_session, |s| (api.create_session)(env.0, model.as_ptr(), options.0, s))?;
            let memory =
                Held::make(&api, api.release_memory, |m| (api.create_memory)(DEVICE_ALLOCATOR, DEFAULT_MEMORY, m))?;
            let tensor = |values: &mut Vec<f32>| {
                let (data, bytes) = (values.as_mut_ptr().cast(), size_of_val(&values[..]));
                Held::make(&api, api.release_value, |t| {
                    (api.create_tensor)(memory.0, data, bytes, dimensions.as_ptr(), dimensions.len(), FLOAT, t)
                })
            };
            let inputs = [tensor(&mut values[0])?, tensor(&mut values[1])?];
            Ok(Session { inputs, session, _memory: memory, _env: env, api, names, values })
        }
    }

    /// The values of an input, to be filled.
    pub fn input(&mut self, i: usize) -> &mut [f32] {
        &mut self.values[i]
    }

    /// Runs the model; `out` must be as long as its output.
    pub fn run(&mut self, out: &mut [f32]) -> Result<(), String> {
        let api = &self.api;
        let names = [self.names[0].as_ptr(), self.names[1].as_ptr()];
        let inputs = [self.inputs[0].0, self.inputs[1].0];
        let wanted = [self.names[2].as_ptr()];
        // SAFETY: names, tensors and session live as long as `self`; the output is the runtime's until it is copied, of
        // the type and length that are checked, and released by `Held`.
        unsafe {
            let output = Held::make(api, api.release_value, |o| {
                (api.run)(self.session.0, null(), names.as_ptr(), inputs.as_ptr(), 2, wanted.as_ptr(), 1, o)
            })?;
            let shape = Held::make(api, api.release_shape, |s| (api.type_and_shape)(output.0, s))?;
            let (mut kind, mut count, mut data) = (0, 0, null_mut());
            api.check((api.element_type)(shape.0, &mut kind))?;
            api.check((api.element_count)(shape.0, &mut count))?;
            api.check((api.tensor_data)(output.0, &mut data))?;
            if kind != FLOAT || count != out.len() {
                let pixels = out.len();
                return Err(format!("its output has {count} values of type {kind}; wanted {pixels} 32-bit floats"));
            }
            // SAFETY: `count` floats, as just checked.
            out.copy_from_slice(std::slice::from_raw_parts(data.cast::<f32>(), count));
        }
        Ok(())
    }
}
