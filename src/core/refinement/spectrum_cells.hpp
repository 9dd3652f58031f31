#pragma once

#include "core/common/image.hpp"

namespace planish {

/// Half spectra of real images (h, w / 2 + 1, 2), real and imaginary parts, w even; cells are every n-th frequency
/// along both axes (h / n, w / 2 / n + 1), h a multiple of n and w of 2 n.

/// Product of two spectra, the second one conjugate, its real part averaged around each cell under a triangle that ends
/// at the next cells.
void spectrum_products(const Image<const float>& first, const Image<const float>& second, int step, int threads,
                       const Image<float>& cells);

/// Multiplies a spectrum by what stands at the cells, linear between them, and by 1 - exp(-(2 pi s f)^2 / 2) for the
/// frequency f [cycles per pixel] and s = `shading` [px].
void weigh_spectrum(const Image<float>& spectrum, const Image<const float>& cells, int step, double shading,
                    int threads);

}  // namespace planish
