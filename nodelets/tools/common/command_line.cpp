// SPDX-License-Identifier: MIT
#include "tools/common/command_line.h"

#include <console_bridge/console.h>
#include <fcntl.h>
#include <unistd.h>

#include <cmath>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <initializer_list>

#include "semantic_lidar_fusion/common/error.h"
#include "semantic_lidar_fusion/common/plain_text.h"

namespace semantic_lidar_fusion {
namespace {

volatile std::sig_atomic_t caught_signal = 0;

void rememberSignal(int signal) { caught_signal = signal; }

/// A signal asked for the end; what was written is removed on the way out.
struct Interrupted {};

/// All that end a program, unless the caller has them ignored (nohup).
void catchSignals() {
  for (const int signal : {SIGINT, SIGTERM, SIGHUP, SIGPIPE}) {
    struct sigaction action {
    }, before{};
    action.sa_handler = rememberSignal;
    ::sigaction(signal, nullptr, &before);
    if (before.sa_handler != SIG_IGN) ::sigaction(signal, &action, nullptr);
  }
  ::signal(SIGXFSZ, SIG_IGN);  // a file size limit is then an error of the write
}

/// Standard streams that are closed become /dev/null: the first file that is opened would take
/// their place, and progress go into it.
void openClosedStreams() {
  for (const int stream : {STDIN_FILENO, STDOUT_FILENO, STDERR_FILENO}) {
    if (::fcntl(stream, F_GETFD) != -1) continue;
    // The lowest number that is free is this one.
    if (::open("/dev/null", O_RDWR) != stream) std::abort();
  }
}

std::vector<std::string> splitAtCommas(const std::string& text) {
  std::vector<std::string> parts(1);
  for (const char c : text) {
    if (c == ',') {
      parts.emplace_back();
    } else {
      parts.back() += c;
    }
  }
  return parts;
}

}  // namespace

double numberOf(const std::string& name, const std::string& text, double least, double most) {
  char* end = nullptr;
  const double value = std::strtod(text.c_str(), &end);
  if (text.empty() || *end != '\0' || !(value >= least && value <= most)) {
    char range[80];
    std::snprintf(range, sizeof range, "%g to %g", least, most);
    throw UsageError(name + " is '" + text + "'; it must be a number from " + range);
  }
  return value;
}

double wholeNumberOf(const std::string& name, const std::string& text, double least, double most) {
  const double value = numberOf(name, text, least, most);
  if (value != std::floor(value)) {
    throw UsageError(name + " is '" + text + "'; it must be a whole number");
  }
  return value;
}

OptionReader::OptionReader(CommonOptions* common) : common_(common) {
  flag("--force", &common->force);
  flag("--quiet", &common->quiet);
  flag("-q", &common->quiet);
  flag("--version", &common->version);
  flag("--help", &common->help);
  flag("-h", &common->help);
}

OptionReader& OptionReader::flag(const std::string& name, bool* set) {
  flags_[name] = set;
  return *this;
}

OptionReader& OptionReader::value(const std::string& name, const Take& take) {
  values_[name] = take;
  return *this;
}

OptionReader& OptionReader::text(const std::string& name, std::string* value) {
  return this->value(name, [value](const std::string& text) { *value = text; });
}

OptionReader& OptionReader::number(const std::string& name, double least, double most,
                                   double* value) {
  return this->value(name,
                     [=](const std::string& text) { *value = numberOf(name, text, least, most); });
}

OptionReader& OptionReader::numbers(const std::string& name, const std::vector<double>& most,
                                    const std::vector<double*>& values) {
  return this->value(name, [=](const std::string& text) {
    const std::vector<std::string> parts = splitAtCommas(text);
    if (parts.size() != most.size()) {
      throw UsageError(name + " is '" + text + "'; it must be " + std::to_string(most.size()) +
                       " numbers with commas between them");
    }
    for (std::size_t i = 0; i < most.size(); ++i) {
      *values[i] = numberOf(name, parts[i], 0.0, most[i]);
    }
  });
}

std::vector<std::string> OptionReader::read(const std::vector<std::string>& arguments) const {
  std::vector<std::string> files;
  bool only_files = false;
  for (std::size_t i = 0; i < arguments.size() && !common_->help && !common_->version; ++i) {
    const std::string& argument = arguments[i];
    if (only_files || argument.size() < 2 || argument[0] != '-') {
      files.push_back(argument);
      continue;
    }
    if (argument == "--") {
      only_files = true;
      continue;
    }
    const auto flag = flags_.find(argument);
    if (flag != flags_.end()) {
      *flag->second = true;
      continue;
    }
    const std::size_t equals = argument.find('=');
    const auto option = values_.find(argument.substr(0, equals));
    if (option == values_.end()) throw UsageError("unknown option " + argument);
    if (equals != std::string::npos) {
      option->second(argument.substr(equals + 1));
    } else if (++i < arguments.size()) {
      option->second(arguments[i]);
    } else {
      throw UsageError(argument + " needs a value");
    }
  }
  return files;
}

void endIfInterrupted() {
  if (caught_signal != 0) throw Interrupted();
}

void printText(const std::string& text) {
  if (std::fputs(text.c_str(), stdout) < 0 || std::fflush(stdout) != 0) {
    throw Error("stdout: cannot be written");
  }
}

int runMain(const std::string& name, const std::function<void()>& run) {
  // Libraries below report through exceptions too; their own lines would come twice.
  console_bridge::setLogLevel(console_bridge::CONSOLE_BRIDGE_LOG_NONE);
  openClosedStreams();
  catchSignals();
  try {
    run();
    return 0;
  } catch (const UsageError& e) {
    std::fprintf(stderr, "%s: %s\nTry: %s --help\n", name.c_str(), e.what(), name.c_str());
    return 2;
  } catch (const Interrupted&) {
    std::fprintf(stderr, "%s: interrupted; nothing was written\n", name.c_str());
    return 128 + caught_signal;
  } catch (const std::exception& e) {
    if (caught_signal != 0) return 128 + caught_signal;  // of the write that it broke
    // Errors hold names of files and texts of messages, which may hold anything.
    constexpr std::size_t kLongest = 4000;
    std::fprintf(stderr, "%s: error: %s\n", name.c_str(), plainText(e.what(), kLongest).c_str());
    return 1;
  }
}

}  // namespace semantic_lidar_fusion
