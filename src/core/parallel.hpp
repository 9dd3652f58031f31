#pragma once

#include <algorithm>
#include <cstddef>
#include <exception>
#include <thread>
#include <vector>

namespace planish {

/// Calls body(begin, end) on consecutive blocks that together cover [0, count), on up to `threads` threads.
///
/// The blocks depend on `threads`, so a body must write only to what belongs to its own indices; sums go through
/// parallel_sum, whose grouping does not depend on the number of threads.
template <class Body>
void parallel_for(std::size_t count, int threads, Body&& body) {
    const auto workers = std::min<std::size_t>(std::max(threads, 1), count);
    if (workers <= 1) {
        if (count > 0) body(std::size_t{0}, count);
        return;
    }
    std::vector<std::exception_ptr> errors(workers);
    std::vector<std::thread> pool;
    pool.reserve(workers - 1);
    const auto run = [&](std::size_t worker) {
        try {
            body(count * worker / workers, count * (worker + 1) / workers);
        } catch (...) {
            errors[worker] = std::current_exception();
        }
    };
    for (std::size_t worker = 1; worker < workers; ++worker) pool.emplace_back(run, worker);
    run(0);
    for (auto& thread : pool) thread.join();
    for (const auto& error : errors)
        if (error) std::rethrow_exception(error);
}

/// Sum of body(begin, end) over blocks of fixed length `block`, added in the order of the blocks: the same bits for
/// any number of threads. `Sum` needs a default (zero) value and operator+=.
template <class Sum, class Body>
Sum parallel_sum(std::size_t count, std::size_t block, int threads, Body&& body) {
    const std::size_t blocks = (count + block - 1) / block;
    std::vector<Sum> partial(blocks);
    parallel_for(blocks, threads, [&](std::size_t first, std::size_t last) {
        for (std::size_t i = first; i < last; ++i) partial[i] = body(i * block, std::min(count, (i + 1) * block));
    });
    Sum total{};
    for (const auto& value : partial) total += value;
    return total;
}

}  // namespace planish
