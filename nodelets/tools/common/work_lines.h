// SPDX-License-Identifier: MIT
#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace semantic_lidar_fusion {

/// Lines of tasks over a few threads. The tasks of one line run in the order in which they were
/// added, one at a time; different lines run side by side. A free thread takes the task of the
/// lowest line that has one, so that what is nearest to the end goes first. Threads sleep when
/// there is nothing to do.
class WorkLines {
 public:
  using Task = std::function<void()>;

  /// Starts `threads` >= 1 threads.
  WorkLines(int threads, std::size_t lines);
  /// Waits for the tasks that run, and drops the others.
  ~WorkLines();
  WorkLines(const WorkLines&) = delete;
  WorkLines& operator=(const WorkLines&) = delete;

  /// May be called by tasks. What is added after a task has failed is dropped.
  void add(std::size_t line, Task task);

  /// Returns when no task is left, or throws what the first task that failed has thrown; the tasks
  /// that wait are dropped then. `checkpoint` is called now and then, and may throw.
  void wait(void (*checkpoint)());

 private:
  struct Line {
    std::deque<Task> tasks;
    bool is_running = false;
  };

  void run();
  Line* nextLine();

  std::mutex mutex_;  ///< guards what follows, except tasks under work
  std::condition_variable changed_, ended_;
  std::vector<Line> lines_;
  std::size_t unfinished_ = 0;  ///< tasks that wait or run
  std::exception_ptr failure_;
  bool stop_ = false;
  std::vector<std::thread> threads_;
};

}  // namespace semantic_lidar_fusion
