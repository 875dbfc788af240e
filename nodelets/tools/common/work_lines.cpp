// SPDX-License-Identifier: MIT
#include "tools/common/work_lines.h"

#include <algorithm>
#include <chrono>
#include <utility>

namespace semantic_lidar_fusion {

WorkLines::WorkLines(int threads, std::size_t lines) : lines_(lines) {
  for (int i = 0; i < threads; ++i) threads_.emplace_back([this] { run(); });
}

WorkLines::~WorkLines() {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    stop_ = true;
  }
  changed_.notify_all();
  for (std::thread& thread : threads_) thread.join();
}

void WorkLines::add(std::size_t line, Task task) {
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (failure_ || stop_) return;
    lines_.at(line).tasks.push_back(std::move(task));
    ++unfinished_;
  }
  changed_.notify_one();
}

void WorkLines::wait(void (*checkpoint)()) {
  constexpr std::chrono::milliseconds kBetweenCheckpoints(50);
  std::unique_lock<std::mutex> lock(mutex_);
  while (!ended_.wait_for(lock, kBetweenCheckpoints, [this] { return unfinished_ == 0; })) {
    lock.unlock();
    checkpoint();
    lock.lock();
  }
  if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
}

/// The lowest line with a task that can start; null if there is none.
WorkLines::Line* WorkLines::nextLine() {
  const auto line = std::find_if(lines_.begin(), lines_.end(), [](const Line& candidate) {
    return !candidate.is_running && !candidate.tasks.empty();
  });
  return line == lines_.end() ? nullptr : &*line;
}

void WorkLines::run() {
  std::unique_lock<std::mutex> lock(mutex_);
  for (;;) {
    Line* line = nullptr;
    changed_.wait(lock, [&] { return stop_ || (line = nextLine()) != nullptr; });
    if (stop_) return;
    line->is_running = true;
    Task task = std::move(line->tasks.front());
    line->tasks.pop_front();
    lock.unlock();
    std::exception_ptr failure;
    try {
      task();
      task = nullptr;  // what it holds goes before the next one starts
    } catch (...) {
      failure = std::current_exception();
    }
    lock.lock();
    line->is_running = false;
    --unfinished_;
    if (failure && !failure_) {
      failure_ = failure;
      for (Line& other : lines_) {
        unfinished_ -= other.tasks.size();
        other.tasks.clear();
      }
    }
    if (unfinished_ == 0) ended_.notify_all();
    // This thread goes on with one task itself; another line may have become free for others.
    if (!line->tasks.empty()) changed_.notify_one();
  }
}

}  // namespace semantic_lidar_fusion
