#pragma once

#include <nanobind/nanobind.h>

// One function per layer of the library; each adds the layer's kernels to the module.

void bind_decoding(nanobind::module_& m);
void bind_sensing(nanobind::module_& m);
void bind_checks(nanobind::module_& m);
void bind_texture(nanobind::module_& m);
void bind_registration(nanobind::module_& m);
void bind_refinement(nanobind::module_& m);
void bind_evaluation(nanobind::module_& m);
void bind_simulation(nanobind::module_& m);
