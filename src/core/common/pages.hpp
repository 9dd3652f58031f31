#pragma once

#include <cstddef>
#include <mutex>
#include <new>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace planish {

/// Memory of one array; its values are not set.
struct Pages {
    void* data = nullptr;
    std::size_t bytes = 0, alignment = 0;
};

/// Gives out memory for arrays and keeps what comes back of the large ones, up to a limit, for the next: to have fresh
/// pages cleared by the system takes as long as decoding a capture into them.
class PagePool {
  public:
    explicit PagePool(std::size_t most_kept) : most_kept_(most_kept) {}

    Pages take(std::size_t bytes) {
        {
            const std::lock_guard lock(mutex_);
            if (bytes < kLarge || paused_) return fresh(bytes, kLine);
            // Whole huge pages, lest the rest be handed out in hundreds of small ones.
            bytes = (bytes + kHugePage - 1) / kHugePage * kHugePage;
            for (auto it = kept_.begin(); it != kept_.end(); ++it)
                if (it->bytes == bytes) {
                    const Pages found = *it;
                    kept_.erase(it);
                    kept_bytes_ -= bytes;
                    return found;
                }
        }
        const Pages pages = fresh(bytes, kHugePage);
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        // Only advice: where it is refused, nothing is lost but time.
        madvise(pages.data, bytes, MADV_HUGEPAGE);
#endif
        return pages;
    }

    void give_back(const Pages& pages) noexcept {
        try {
            const std::lock_guard lock(mutex_);
            if (pages.alignment == kHugePage && !paused_ && kept_bytes_ + pages.bytes <= most_kept_) {
                kept_.push_back(pages);
                kept_bytes_ += pages.bytes;
                return;
            }
        } catch (...) {
            // Not kept, then.
        }
        release(pages);
    }

    /// While the allocator itself keeps what is freed, for arrays of any size, nothing is kept here.
    void pause(bool paused) {
        std::vector<Pages> dropped;
        {
            const std::lock_guard lock(mutex_);
            paused_ = paused;
            if (!paused) return;
            dropped.swap(kept_);
            kept_bytes_ = 0;
        }
        for (const auto& pages : dropped) release(pages);
    }

  private:
    static constexpr std::size_t kLine = 64, kHugePage = std::size_t{1} << 21U, kLarge = 2 * kHugePage;

    static Pages fresh(std::size_t bytes, std::size_t alignment) {
        return {::operator new(bytes, std::align_val_t{alignment}), bytes, alignment};
    }
    static void release(const Pages& pages) noexcept {
        ::operator delete(pages.data, std::align_val_t{pages.alignment});
    }

    std::mutex mutex_;
    std::vector<Pages> kept_;
    std::size_t most_kept_, kept_bytes_ = 0;
    bool paused_ = false;
};

}  // namespace planish
