#include "core/texture/contrast_excess.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace planish {
namespace {

/// The middle of the values, or the mean of the two in the middle; changes their order.
float median(std::vector<float>& values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    if (values.size() % 2 != 0) return *middle;
    return 0.5F * (*middle + *std::max_element(values.begin(), middle));
}

/// The difference of the relative grey values of a pixel over its deviation; not finite where one does not count.
float difference(const Level& first, const Level& other, const Image<const float>& expected, int factor, int v, int u) {
    const auto relative = [&](const Level& kind) {
        const float grey = *kind.exposed.image.at(v, u);
        const bool counts = grey > kind.exposed.low && grey < kind.exposed.high;
        return counts ? grey / *kind.level.at(v / factor, u / factor) : std::nanf("");
    };
    return (relative(other) - relative(first)) / std::sqrt(*expected.at(v / factor, u / factor));
}

}  // namespace

Scatter contrast_scatter(const Level& first, const Level& other, const Image<const float>& expected, int factor,
                         int step) {
    const Exposed& exposed = first.exposed;
    std::vector<float> values;
    for (int v = step / 2; v < exposed.image.height; v += step)
        for (int u = step / 2; u < exposed.image.width; u += step) {
            if (!exposed.seen.empty() && *exposed.seen.at(v, u) == 0) continue;
            const float value = difference(first, other, expected, factor, v, u);
            if (std::isfinite(value)) values.push_back(value);
        }
    if (values.empty()) return {};
    const auto count = static_cast<int>(values.size());
    const float middle = median(values);
    for (float& value : values) value = std::fabs(value - middle);
    return {count, median(values)};
}

}  // namespace planish
