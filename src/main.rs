//! `stipple`: argv to command; nothing else.

use stipple::mem::CountingAllocator;

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

fn main() -> std::process::ExitCode {
    stipple::commands::main()
}
