#pragma once

#include <vector>

#include "core/image.hpp"

namespace planish {

/// An image with the grey values that count: above `low` and below `high`; NaN never counts.
struct Exposed {
    Image<const float> image;
    float low = 0, high = 0;
};

/// Sum and number of the pixels that count over blocks of `factor` x `factor` pixels, those at the rim smaller.
void block_sums(const Exposed& exposed, int factor, int threads, const Image<float>& sum, const Image<float>& count);

/// What the low-pass over blocks says of the images of one camera, each (h, w), K images in the order of `Exposed`.
struct ContrastPlan {
    std::vector<Image<const float>> inverse_level;  ///< 1 / expected grey value, interpolated between block centres
    std::vector<Image<const float>> weight;         ///< of the image's contrast, constant over a block; 0 = unknown
    std::vector<Image<const float>> noise;  ///< K x K: covariance of the contrasts' noise, constant over a block
    int factor = 1;
    float limit = 1;  ///< contrasts are clipped here
};

/// Weighted mean of the contrasts I / level - 1 of all images that count in a pixel, and its variance; NaN where none.
void camera_contrast(const std::vector<Exposed>& images, const ContrastPlan& plan, int threads,
                     const Image<float>& value, const Image<float>& variance);

/// One camera's share of the texture.
struct ContrastView {
    Image<const float> value, variance;  ///< on the camera's own grid; NaN where unknown
    Image<const float> place;            ///< own pixel (u, v) per pixel of the organising grid; empty: the same pixel
    Image<const float> shading;          ///< (h, w): expected brightness over its low-pass
    Image<const float> trust;            ///< (h, w): factor of the weight
};

/// Mean of the views on the organising grid, weighted by trust / variance, and its standard deviation; NaN where no
/// view knows the pixel or `valid` (H, W) is 0. (1 + value) / shading - 1 takes the shading off. A view with `place` is
/// read by cubic convolution, whose weights give its noise.
void merge_contrasts(const std::vector<ContrastView>& views, const Image<const unsigned char>& valid, int factor,
                     int threads, const Image<float>& value, const Image<float>& sigma);

}  // namespace planish
