#pragma once

namespace planish {

/// Asks for what will be read soon.
inline void prefetch([[maybe_unused]] const void* place) {
#if defined(__GNUC__)
    __builtin_prefetch(place);
#endif
}

}  // namespace planish
