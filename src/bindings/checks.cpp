// Kernels of the checks that a capture makes of itself.

#include <cstdint>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "core/checks/shift_sums.hpp"

namespace {

Out<double, 3> shift_sums(const In<float, 2>& first, const In<float, 2>& last, const In<std::uint8_t, 2>& usable,
                          float offset, float slope, float share_first, float share_last, int threads) {
    const auto a = view<float, 2>(first), b = view<float, 2>(last);
    const auto use = view<std::uint8_t, 2>(usable);
    const Owned<double> sums(a.height / planish::kShiftBlock, a.width / planish::kShiftBlock, planish::kShiftSums);
    {
        nb::gil_scoped_release release;
        planish::shift_sums(a, b, use, {offset, slope, share_first, share_last}, threads, sums.image);
    }
    return sums.maps();
}

}  // namespace

void bind_checks(nb::module_& m) { m.def("shift_sums", &shift_sums); }
