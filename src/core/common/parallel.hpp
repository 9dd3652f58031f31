#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <exception>
#include <thread>
#include <vector>

namespace planish {

/// Calls run(worker) for each of `workers` threads, this one among them; exceptions come back.
template <class Run>
void run_workers(std::size_t workers, Run&& run) {
    if (workers <= 1) {
        if (workers == 1) run(std::size_t{0});
        return;
    }
    std::vector<std::exception_ptr> errors(workers);
    std::vector<std::thread> pool;
    pool.reserve(workers - 1);
    const auto guarded = [&](std::size_t worker) {
        try {
            run(worker);
        } catch (...) {
            errors[worker] = std::current_exception();
        }
    };
    for (std::size_t worker = 1; worker < workers; ++worker) pool.emplace_back(guarded, worker);
    guarded(0);
    for (auto& thread : pool) thread.join();
    for (const auto& error : errors)
        if (error) std::rethrow_exception(error);
}

/// Calls body(begin, end) on consecutive blocks that together cover [0, count), on up to `threads` threads.
///
/// The blocks depend on `threads`, so a body must write only to what belongs to its own indices; sums go through
/// parallel_sum, whose grouping does not depend on the number of threads.
template <class Body>
void parallel_for(std::size_t count, int threads, Body&& body) {
    const auto workers = std::min<std::size_t>(std::max(threads, 1), count);
    run_workers(workers, [&](std::size_t worker) { body(count * worker / workers, count * (worker + 1) / workers); });
}

/// Calls body(i) for all i in [0, count): each thread takes the next one, as some take much longer than others.
template <class Body>
void parallel_tasks(std::size_t count, int threads, Body&& body) {
    const auto workers = std::min<std::size_t>(std::max(threads, 1), count);
    std::atomic<std::size_t> next{0};
    run_workers(workers, [&](std::size_t) {
        for (std::size_t i = next++; i < count; i = next++) body(i);
    });
}

/// Sum of body(begin, end) over blocks of fixed length `block`, added in the order of the blocks: the same bits for
/// any number of threads. `Sum` needs a default (zero) value and operator+=.
template <class Sum, class Body>
Sum parallel_sum(std::size_t count, std::size_t block, int threads, Body&& body) {
    const std::size_t blocks = (count + block - 1) / block;
    std::vector<Sum> partial(blocks);
    parallel_tasks(blocks, threads,
                   [&](std::size_t i) { partial[i] = body(i * block, std::min(count, (i + 1) * block)); });
    Sum total{};
    for (const auto& value : partial) total += value;
    return total;
}

}  // namespace planish
