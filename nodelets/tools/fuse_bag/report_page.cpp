// SPDX-License-Identifier: MIT
#include "tools/fuse_bag/report_page.h"

#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <climits>
#include <cstring>
#include <vector>

#include "semantic_lidar_fusion/common/error.h"

namespace semantic_lidar_fusion {

std::string reportProgram() {
  char self[PATH_MAX];
  const ssize_t length = readlink("/proc/self/exe", self, sizeof(self));
  std::string program(self, length > 0 ? static_cast<std::size_t>(length) : 0);
  program = program.substr(0, program.rfind('/') + 1) + "make_report.py";
  if (access(program.c_str(), X_OK) != 0) {
    throw Error("--report: " + program + ": " + std::strerror(errno));
  }
  return program;
}

void writeReport(const std::string& program, const std::string& bag, const std::string& page,
                 bool quiet) {
  // "=" and "./" keep names that begin with a dash names.
  std::vector<std::string> words = {program, "--out=" + page};
  if (quiet) words.push_back("--quiet");
  words.push_back(bag.front() == '-' ? "./" + bag : bag);
  std::vector<char*> arguments;
  for (std::string& word : words) arguments.push_back(word.data());
  arguments.push_back(nullptr);
  pid_t child = 0;
  const int failure =
      posix_spawn(&child, arguments[0], nullptr, nullptr, arguments.data(), environ);
  if (failure != 0) throw Error("--report: " + program + ": " + std::strerror(failure));
  int status = 0;
  while (waitpid(child, &status, 0) < 0 && errno == EINTR) {
  }
  if (status != 0) throw Error(page + ": is not written; make_report.py has said why");
}

}  // namespace semantic_lidar_fusion
