// The module: src/bindings/ is the only folder that knows Python. It turns arrays into views, releases the GIL and
// turns results into arrays. Names, checks, defaults and error texts belong to the Python side.

#include <nanobind/nanobind.h>

#include <thread>

#if defined(__GLIBC__)
#include <malloc.h>
#endif
#if defined(__linux__)
#include <sys/prctl.h>
#endif

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"

using namespace nanobind::literals;

namespace {

bool cpu_has_avx2() {
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return false;
#endif
}

void release_memory() {
#if defined(__GLIBC__)
    malloc_trim(0);
#endif
}

/// Whether what is touched for the first time may come in huge pages; returns whether it might. In a virtual machine,
/// memory in pieces of that size is what has been handed back to the host: to get it again takes several times as long
/// as to have small pages cleared, and these are used again and again here.
bool allow_huge_pages([[maybe_unused]] bool allow) {
#if defined(PR_SET_THP_DISABLE)
    const bool allowed = prctl(PR_GET_THP_DISABLE, 0UL, 0UL, 0UL, 0UL) == 0;
    prctl(PR_SET_THP_DISABLE, allow ? 0UL : 1UL, 0UL, 0UL, 0UL);
    return allowed;
#else
    return true;
#endif
}

/// Maps and what lies between them come and go by the gigabyte, and to have fresh pages cleared by the system takes
/// longer than most of what is written into them.
void keep_memory(bool keep) {
#if defined(__GLIBC__)
    // Else the values that the allocator itself arrives at where large blocks are freed; 0 = as many as it likes.
    constexpr int kEverything = 0x7FFFFFFF, kMapped = 32 << 20, kTrimmed = 64 << 20;
    mallopt(M_MMAP_THRESHOLD, keep ? kEverything : kMapped);
    mallopt(M_TRIM_THRESHOLD, keep ? kEverything : kTrimmed);
    // What one thread has freed serves all others.
    mallopt(M_ARENA_MAX, keep ? 1 : 0);
    page_pool().pause(keep);
    if (!keep) release_memory();
#else
    static_cast<void>(keep);
#endif
}

}  // namespace

NB_MODULE(PLANISH_MODULE, m) {
    m.def("cpu_has_avx2", &cpu_has_avx2, "True where the AVX2 + FMA build of the kernels may be used.");
    m.def("cpu_count", [] { return static_cast<int>(std::thread::hardware_concurrency()); });
    m.def("release_memory", &release_memory, nanobind::call_guard<nanobind::gil_scoped_release>(),
          "Gives the system back what the allocator keeps of freed memory, where it can be told to.");
    m.def("keep_memory", &keep_memory, "keep"_a, nanobind::call_guard<nanobind::gil_scoped_release>(),
          "Lets the allocator keep freed memory, up to 2 GiB, for the next arrays, or no longer.");
    m.def("allow_huge_pages", &allow_huge_pages, "allow"_a,
          "Whether the system may give this process huge pages; returns whether it might before.");
    bind_decoding(m);
    bind_sensing(m);
    bind_checks(m);
    bind_texture(m);
    bind_registration(m);
    bind_refinement(m);
    bind_evaluation(m);
    bind_simulation(m);
}
