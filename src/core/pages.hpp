#pragma once

#include <cstddef>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace planish {

/// Memory that is not set, and what gives it back.
struct Pages {
    void* data = nullptr;
    void (*free)(void*) noexcept = nullptr;
};

/// Memory for an array. Large ones ask for huge pages: handing out a map of 1.4 million pixels in pages of 4 KiB costs
/// a third of the time of computing it.
inline Pages allocate_pages(std::size_t bytes) {
    constexpr std::size_t kHugePage = std::size_t{1} << 21U, kLine = 64;
    if (bytes < 2 * kHugePage)
        return {::operator new(bytes, std::align_val_t{kLine}),
                [](void* p) noexcept { ::operator delete(p, std::align_val_t{kLine}); }};
    void* data = ::operator new(bytes, std::align_val_t{kHugePage});
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    // Only advice: where it is refused, nothing is lost but time.
    madvise(data, bytes, MADV_HUGEPAGE);
#endif
    return {data, [](void* p) noexcept { ::operator delete(p, std::align_val_t{kHugePage}); }};
}

}  // namespace planish
