#pragma once

#include <Eigen/Core>

namespace planish {

/// As many values as one instruction takes.
struct Packet {
    using Values = Eigen::internal::packet_traits<float>::type;
    static constexpr int size = Eigen::internal::packet_traits<float>::size;

    Values values;

    Packet() : values(Eigen::internal::pset1<Values>(0.0F)) {}
    explicit Packet(const float* from) : values(Eigen::internal::ploadu<Values>(from)) {}

    /// Adds a * b, in one instruction where there is one: loops that add products up are bound by their arithmetic.
    void add_product(const Packet& a, const Packet& b) { values = Eigen::internal::pmadd(a.values, b.values, values); }
    [[nodiscard]] float sum() const { return Eigen::internal::predux(values); }
};

}  // namespace planish
