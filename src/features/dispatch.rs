//! One source, two machine codes: run-time dispatch of the pixel kernels.
//!
//! Purpose: a kernel is written once, as fixed-size loops that the compiler turns into vectors. [`simd_kernel`] compiles
//! that body twice on x86-64, for the baseline (SSE2) and for AVX2 with POPCNT, and picks by what the processor has.
//! On other architectures (NEON is part of the aarch64 baseline) the one body is called directly.
//! The baseline version is the scalar twin: tests hold the two against each other and against a plain definition.
//! Cost: one cached look-up of the processor's features a call, so a kernel should do a row or a patch, not a pixel.
//! It deliberately uses no intrinsics: the only thing unsafe is to call a function that needs a feature.

/// Defines `fn name(args) -> ret` that calls `body(args)`, compiled for AVX2 where the processor has it.
///
/// `body` must be `#[inline(always)]`, or it would not be compiled again with the wider registers.
macro_rules! simd_kernel {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $ret:ty)? = $body:path) => {
        $(#[$meta])*
        #[inline]
        #[allow(clippy::too_many_arguments)]
        $vis fn $name($($arg: $type),*) $(-> $ret)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,bmi1,bmi2,popcnt")]
                #[allow(clippy::too_many_arguments)]
                fn wide($($arg: $type),*) $(-> $ret)? {
                    $body($($arg),*)
                }
                if $crate::features::dispatch::has_wide() {
                    // SAFETY: the processor has every feature that `wide` is compiled for, as `has_wide` has just said.
                    return unsafe { wide($($arg),*) };
                }
            }
            $body($($arg),*)
        }
    };
}
pub(crate) use simd_kernel;

/// Whether the processor has what the wide kernels are compiled for.
#[cfg(target_arch = "x86_64")]
#[inline]
pub(crate) fn has_wide() -> bool {
    is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2")
        && is_x86_feature_detected!("popcnt")
}
